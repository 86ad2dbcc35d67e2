"""A finished map as the commands take it: the mesh and, where it has one, its texture."""

from __future__ import annotations

from pathlib import Path

from artemis_edge.errors import InputError
from artemis_edge.export.atlas import Atlas, read_atlas
from artemis_edge.export.ply import Mesh, find_mesh, read_mesh

#: Folder of an output directory with what reopens the map.
MAP_FOLDER = "map"


def map_folder(map_path: Path) -> Path | None:
    """The folder ``map/`` that belongs to MAP (an output directory or its ``mesh.ply``); None without one."""
    root = map_path if map_path.is_dir() else map_path.parent
    return root / MAP_FOLDER if (root / MAP_FOLDER).is_dir() else None


def open_map(map_path: Path, textured: bool = True) -> tuple[Mesh, Atlas | None]:
    """Mesh and atlas of MAP; the atlas is None where there is none or not ``textured``.

    Raises InputError when the mesh is not there or is not the one that the atlas was made for.
    """
    mesh = read_mesh(find_mesh(map_path))
    folder = map_folder(map_path) if textured else None
    atlas = None if folder is None else read_atlas(folder)
    if atlas is not None and len(atlas.page) != len(mesh.faces):
        raise InputError(
            f"the texture in {folder} is of {len(atlas.page)} triangles, {find_mesh(map_path)} has "
            f"{len(mesh.faces)}; write the map again or use --no-textured"
        )
    return mesh, atlas
