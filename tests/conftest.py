"""For all tests: what they fill the memory with before the first one runs."""

import gc


def pytest_collection_finish() -> None:
    """Half a million objects of libraries stay to the end; looking through them takes 0.4 s, and each run of the driver
    asks for it."""
    gc.collect()
    gc.freeze()
