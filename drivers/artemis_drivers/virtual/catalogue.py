"""The virtual worlds by name, and worlds from files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from artemis_drivers.virtual import bench, corridor, courtyard, hall, loaded, street
from artemis_drivers.virtual.textures import TextureAtlas
from artemis_drivers.virtual.world import World

_LEAST_STREET_M = 100.0  # so that even a short walk looks down a street
MODEL_SUFFIXES = (".glb", ".gltf", ".obj")

#: Builds a world from (seed, length of path in metres that a walk needs at least).
BuildWorld = Callable[[int, float], World]


def worlds() -> dict[str, BuildWorld]:
    """All worlds; each is built with ``worlds()[name](seed, length_m)``."""
    return {
        "street": _street,
        "courtyard": courtyard.build,
        "hall": hall.build,
        "corridor": corridor.build_corridor,
        "facade": corridor.build_facade,
        "bench": bench.build,
    }


def _street(seed: int, length: float, atlas: TextureAtlas | None = None) -> World:
    return street.build(seed, max(length + 2 * street.END_MARGIN_M, _LEAST_STREET_M), atlas)


def build_world(name: str, seed: int, length: float) -> World:
    """The world called ``name``, or the one in the file of that name (.glb, .gltf, .obj).

    Raises ValueError, one sentence, when there is none or the file cannot be used.
    """
    known = worlds()
    if name in known:
        return known[name](seed, length)
    if Path(name).suffix.lower() in MODEL_SUFFIXES:
        return loaded.load(Path(name), seed, length)
    raise ValueError(
        f"no virtual world named '{name}'; there are: {', '.join(known)}, and files that end in "
        f"{', '.join(MODEL_SUFFIXES)}"
    )
