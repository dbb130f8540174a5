"""SciPy's LAPACK and Qhull without the packages around them, which take 0.4 s to import: a third of a short command.

Each is an extension module that needs nothing of its package. Where one cannot be loaded so, as another SciPy may keep
it elsewhere, the package is imported.
"""

from __future__ import annotations

import sys
from importlib import import_module, machinery, util
from pathlib import Path
from types import ModuleType

import scipy


def _alone(name: str) -> ModuleType:
    """The extension module of this full name, from its file; the packages that it lies in are not imported."""
    if name in sys.modules:
        return sys.modules[name]
    *folders, last = name.split(".")[1:]
    place = Path(scipy.__file__).parent.joinpath(*folders)
    for suffix in machinery.EXTENSION_SUFFIXES:
        spec = util.spec_from_file_location(name, place / (last + suffix))
        if spec is not None and spec.loader is not None and (place / (last + suffix)).is_file():
            module = util.module_from_spec(spec)
            spec.loader.exec_module(module)
            sys.modules[name] = module  # where SciPy finds it, if its package is imported later
            return module
    raise ImportError(f"{name} is not in {place}")


def _first(private: list[str], public: str) -> ModuleType:
    """The last of some private modules, loaded in this order; the public one where that fails."""
    try:
        return [_alone(name) for name in private][-1]
    except ImportError:
        return import_module(public)


_lapack = _first(["scipy.linalg._flapack"], "scipy.linalg.lapack")
_qhull = _first(["scipy.linalg.cython_lapack", "scipy.spatial._qhull"], "scipy.spatial")
dposv, dtbtrs = _lapack.dposv, _lapack.dtbtrs
ConvexHull, QhullError = _qhull.ConvexHull, _qhull.QhullError
