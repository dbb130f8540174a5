"""Reading mesh files that somebody else made: plain formats of limited size, no archives, no files beside them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from trimesh import Trimesh

FORMATS = (".stl", ".obj", ".ply", ".off")
LARGEST = 50_000_000  # bytes
MOST_FACES = 1_000_000


def read_mesh_file(file: str | Path) -> Trimesh:
    """The triangles of a file, all its parts as one. Raises ValueError, what is wrong as the end of a sentence."""
    import trimesh

    path = Path(file)
    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"is not of a known format; give a file that ends in {', '.join(FORMATS)}")
    try:
        size = path.stat().st_size
    except (OSError, ValueError) as error:
        raise ValueError(f"cannot be read ({error})") from None
    if size > LARGEST:
        raise ValueError(f"has {size / 1e6:.0f} MB; at most {LARGEST / 1e6:.0f} MB are read: simplify it")
    try:
        with path.open("rb") as content:
            mesh = trimesh.load(content, file_type=path.suffix.lower()[1:], force="mesh")
    except Exception as error:  # each of the library's readers raises whatever it meets
        raise ValueError(f"cannot be read ({type(error).__name__}: {str(error)[:200]})") from None
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise ValueError("holds no triangles")
    if len(mesh.faces) > MOST_FACES:
        raise ValueError(f"has {len(mesh.faces)} triangles; at most {MOST_FACES} are accepted: simplify it")
    return mesh
