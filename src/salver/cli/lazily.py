"""Modules that a command loads when it uses them, though another package asks for them by name.

SciPy takes over every name of NumPy, that of its Fortran wrapper and that of its test tools among them. Both are loaded
by this, in a tenth of a second, and used by nothing here.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys

UNUSED = ("numpy.f2py", "numpy.testing")


def load_when_used(names: tuple[str, ...] = UNUSED) -> None:
    """Put modules in their packages that are loaded when something of them is first read; those that are loaded, or
    that there are not, stay as they are."""
    for name in names:
        package, _, own = name.rpartition(".")
        parent = importlib.import_module(package)
        spec = None if name in sys.modules else importlib.util.find_spec(name)
        if spec is None or spec.loader is None:
            continue
        loader = importlib.util.LazyLoader(spec.loader)
        spec.loader = loader
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        loader.exec_module(module)
        setattr(parent, own, module)
