"""Reading of mesh files from untrusted sources: plain formats of limited size, no archives, no referenced files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from salver.errors import reason

if TYPE_CHECKING:
    from trimesh import Trimesh

FORMATS = (".stl", ".obj", ".ply", ".off")
LARGEST = 50_000_000  # bytes of a mesh or a URDF


def read_mesh_file(file: str | Path, most: int = 1_000_000) -> Trimesh:
    """The triangles of all parts of a file, up to a largest number. Raises ValueError, whose message continues a
    sentence."""
    import trimesh

    path = Path(file)
    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"is not of a known format; give a file that ends in {', '.join(FORMATS)}")
    try:
        size = path.stat().st_size
    except (OSError, ValueError) as error:
        raise ValueError(f"cannot be read ({reason(error)})") from None
    if size > LARGEST:
        raise ValueError(f"has {size / 1e6:.0f} MB; at most {LARGEST / 1e6:.0f} MB are read: simplify it")
    try:
        with path.open("rb") as content:
            scene = trimesh.load(content, file_type=path.suffix.lower()[1:], force="scene", process=False)
            parts = [part for part in scene.geometry.values() if isinstance(part, trimesh.Trimesh)]
            finite = all(np.isfinite(part.vertices).all() for part in parts)
            for part in parts:  # triangles with NaN corners are silently dropped here
                part.process()
            mesh = scene.to_mesh() if parts else None
    except Exception as error:  # the library's readers raise various exceptions
        raise ValueError(f"cannot be read ({type(error).__name__}: {str(error)[:200]})") from None
    if not finite:
        raise ValueError("has corners that are not finite")
    if mesh is None or len(mesh.faces) == 0:
        raise ValueError("holds no triangles")
    if len(mesh.faces) > most:
        raise ValueError(f"has {len(mesh.faces)} triangles; at most {most} are accepted: simplify it")
    return mesh
