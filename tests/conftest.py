"""For all tests: what several files of them share, and what they fill the memory with before the first one runs."""

from __future__ import annotations

import gc
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from driver_rig import Rig


@pytest.fixture(scope="session")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    """A plan of the paper's cube and an arm that follows it, at which faults can be thrown."""
    from driver_rig import Rig

    return Rig(tmp_path_factory.mktemp("rig") / "run")


@pytest.fixture(scope="session")
def safe(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    """The same with stops that keep the load."""
    from driver_rig import Rig

    return Rig(tmp_path_factory.mktemp("safe") / "run", every=0.2)


def pytest_collection_finish() -> None:
    """Half a million objects of libraries stay to the end; looking through them takes 0.4 s, and each run of the driver
    asks for it."""
    gc.collect()
    gc.freeze()
