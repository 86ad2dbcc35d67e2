"""A world from a user's model: node names are labels, nodes named path_1, path_2 ... are the walk.

A node "bench_2" (also "bench.002" or "Bench-2") is class bench, instance 2: nodes of one class and number are
one object. Names that are no class of ours become classes of the loaded world. glTF is y up by its
specification and is turned; OBJ is taken as z up. Lengths are metres. A class "glass", or a material that is
blended with an alpha below 0.9, lets LiDAR beams pass.
"""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
from scipy import ndimage

from artemis_drivers.virtual.mesh_builder import CLASS_NAMES, F64, I32, U8, WorldMesh
from artemis_drivers.virtual.model import Look, Model, ModelError, Part, read_model
from artemis_drivers.virtual.raycast import build_bvh, cast
from artemis_drivers.virtual.route import laps, resampled, rounded_loop
from artemis_drivers.virtual.textures import SIZE, Material, TextureAtlas, pack_atlas
from artemis_drivers.virtual.world import World, random_sun

EYE_M = 1.45
_NUMBERED = re.compile(r"^(.*?)[_.\- ]*(\d*)$")
_REFLECTIVITY = 0.4  # at 905 nm, of everything loaded: an assumption
_MACRO_GREY = 217  # of the slow picture where nothing is to change (shading._MACRO_MEAN)
_MOST_MATERIALS, _MOST_CLASSES = 255, 255
_CELL_M = 0.2  # of the map of free ground
_FREE_M = 0.6  # kept free around a walk that is found
_HEAD_M = 1.9  # up to which height things are in the way
_LEAST_LOOP_M = 6.0
_LEAST_AREA_M2 = 1e-10


def load(path: Path, seed: int = 0, length: float = 100.0) -> World:
    """World of a .glb, .gltf or .obj file; the seed places the sun.

    Raises ModelError (a ValueError of one sentence) when the file cannot be used.
    """
    model = read_model(path)
    scenery = [p for p in model.parts if not _is_path(p.names[0]) and len(p.corners)]
    if not scenery:
        raise ModelError(f"{path} has no triangles; export meshes, not curves or instances")
    notes: list[str] = []
    atlas, material_of = _atlas(scenery, notes)
    mesh, names = _mesh(scenery, material_of, notes, path)
    walk = _given_walk(model, path) if _has_path(model) else _found_walk(mesh, path)
    walk = _long_enough(walk, length, path)
    _check_clear(walk, mesh, names, path)
    low, high = mesh.vertices[:, 0].min(), mesh.vertices[:, 0].max()
    return World(
        name=path.stem,
        seed=seed,
        block_edges=np.array([low, high], np.float64),
        build_block=lambda _: mesh,
        path=walk,
        sun=random_sun(np.random.default_rng([seed, 1])),
        atlas=atlas,
        class_names=names,
        notes=tuple(notes),
    )


def label_of(name: str) -> tuple[str, int | None]:
    """Class and instance number that a node's name tells: "bench_2" -> ("bench", 2)."""
    match = _NUMBERED.match(name.strip())
    assert match is not None  # the pattern matches everything
    label = re.sub(r"[^a-z0-9]+", "_", match[1].lower()).strip("_")
    return label, int(match[2]) if match[2] else None


def _is_path(name: str) -> bool:
    label, number = label_of(name)
    return label == "path" and number is not None


def _part_label(part: Part) -> tuple[str, int | None]:
    """Label of the nearest node above whose class is known, else of the part's own node."""
    labels = [label_of(n) for n in part.names if n]
    known = [pair for pair in labels if pair[0] in CLASS_NAMES[1:]]
    return (known or labels or [("other", None)])[0]


def _atlas(parts: list[Part], notes: list[str]) -> tuple[TextureAtlas, list[int]]:
    """Textures of all looks, and the material of each part."""
    slow = np.full((SIZE, SIZE, 3), _MACRO_GREY, np.uint8)
    materials = {"macro": Material(slow, 1.0, 0.0)}
    numbers = []
    for part in parts:
        glass = part.look.glass or _part_label(part)[0] == "glass"
        name = f"{part.look.name}{' (glass)' if glass else ''}"
        if name not in materials:
            picture = _picture(part.look, notes)
            materials[name] = Material(picture, 1.0, 0.08 if glass else _REFLECTIVITY, 0.3 * glass, glass)
        numbers.append(list(materials).index(name))
    if len(materials) > _MOST_MATERIALS:
        raise ModelError(f"the model has {len(materials) - 1} materials; join some, 254 can be used")
    return pack_atlas(materials.items()), numbers


def _picture(look: Look, notes: list[str]) -> U8:
    if look.picture is None:
        return np.full((SIZE, SIZE, 3), 255, np.uint8)
    high, wide = look.picture.shape[:2]
    if (high, wide) == (SIZE, SIZE):
        return look.picture
    if max(high, wide) > SIZE:
        notes.append(f"texture '{look.name}' of {wide} x {high} pixels is scaled down to {SIZE} x {SIZE}")
    way = cv2.INTER_AREA if max(high, wide) > SIZE else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(look.picture, (SIZE, SIZE), interpolation=way), np.uint8)


def _mesh(
    parts: list[Part], material_of: list[int], notes: list[str], path: Path
) -> tuple[WorldMesh, tuple[str, ...]]:
    names = list(CLASS_NAMES)
    objects: dict[tuple[str, int | str], int] = {}
    columns: list[tuple[F64, F64, int, Look, int, int]] = []
    dropped = 0
    for k, part in enumerate(parts):
        label, number = _part_label(part)
        label = label or "other"
        if label not in names:
            names.append(label)
        # without a number, a node is an object of its own
        key = (label, number if number is not None else "/".join(part.names))
        instance = objects.setdefault(key, len(objects))
        if not np.isfinite(part.corners).all():
            raise ModelError(
                f"{path} has vertices that are not numbers (node '{part.names[0]}'); export it again"
            )
        sides = np.cross(part.corners[:, 1] - part.corners[:, 0], part.corners[:, 2] - part.corners[:, 0])
        kept = np.linalg.norm(sides, axis=1) / 2 > _LEAST_AREA_M2
        dropped += int((~kept).sum())
        corners, uv = part.corners[kept], part.uv[kept]
        if part.look.double_sided:
            corners, uv = (np.concatenate([a, a[:, ::-1]]) for a in (corners, uv))
        columns.append((corners, uv, material_of[k], part.look, names.index(label), instance))
    if len(names) > _MOST_CLASSES:
        raise ModelError(f"{path} has {len(names)} classes; name nodes class_number, as in bench_2")
    if dropped:
        notes.append(f"{dropped} triangles without area were left out")
    return _joined(columns), tuple(names)


def _joined(columns: list[tuple[F64, F64, int, Look, int, int]]) -> WorldMesh:
    count = [len(c[0]) for c in columns]
    corners = np.concatenate([c[0] for c in columns]).astype(np.float32)
    tint = np.array([c[3].tint for c in columns])
    return WorldMesh(
        corners.reshape(-1, 3),
        np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3),
        np.concatenate([c[1] for c in columns]).astype(np.float32),
        np.repeat(np.array([c[2] for c in columns], np.uint16), count),
        np.repeat(np.rint(np.clip(tint, 0, 1) * 255).astype(np.uint8), count, axis=0),
        np.repeat(np.array([c[4] for c in columns], np.uint8), count),
        np.repeat(np.array([c[5] for c in columns], np.int32), count),
    )


def _has_path(model: Model) -> bool:
    return any(_is_path(n) for n in model.places) or any(_is_path(p.names[0]) for p in model.parts)


def _given_walk(model: Model, path: Path) -> F64:
    """Line through the places of the nodes path_1, path_2 ...: where the eyes go."""
    found: dict[int, F64] = {}
    for name, place in model.places.items():
        if _is_path(name):
            found[label_of(name)[1] or 0] = place
    for part in model.parts:
        if _is_path(part.names[0]):
            found[label_of(part.names[0])[1] or 0] = part.corners.reshape(-1, 3).mean(axis=0)
    points = np.array([found[k] for k in sorted(found)])
    if len(points) < 2 or np.linalg.norm(np.diff(points, axis=0), axis=1).sum() < 1.0:
        raise ModelError(f"{path} has a path of less than 1 m; give nodes path_1, path_2 ... at eye height")
    ends_meet = len(points) > 3 and np.linalg.norm(points[0] - points[-1]) < 0.5
    return rounded_loop(points[:-1], 0.6) if ends_meet else _soft(points)


def _long_enough(walk: F64, length: float, path: Path) -> F64:
    """Laps of a closed line; an open one as it is."""
    if np.allclose(walk[0], walk[-1]):
        return laps(walk, length)
    own = float(np.linalg.norm(np.diff(walk, axis=0), axis=1).sum())
    if own < length:
        raise ModelError(
            f"the path in {path} is {own:.0f} m long and the walk needs {length:.0f} m; make it longer, end it "
            f"where it begins so that it is walked in laps, or walk for a shorter time"
        )
    return walk


def _check_clear(walk: F64, mesh: WorldMesh, names: tuple[str, ...], path: Path) -> None:
    step = np.diff(walk, axis=0)
    long = np.linalg.norm(step, axis=1)
    hits = cast(build_bvh(mesh.corners()), walk[:-1], step / long[:, None], float(long.max()))
    met = np.flatnonzero((hits.triangle >= 0) & (hits.distance_m < long))
    if len(met):
        what, (x, y, z) = names[mesh.class_id[hits.triangle[met[0]]]], walk[met[0]]
        raise ModelError(
            f"the walk in {path} runs into something of class {what} at x {x:.1f}, y {y:.1f}, z {z:.1f} m (z up); "
            f"move the nodes path_1, path_2 ..."
        )


def _soft(points: F64) -> F64:
    fine = resampled(points, 0.05)
    return resampled(ndimage.gaussian_filter1d(fine, 6.0, axis=0, mode="nearest"), 0.25)


def _found_walk(mesh: WorldMesh, path: Path) -> F64:
    """A loop around the largest piece of free ground, at eye height."""
    corners = mesh.corners().astype(np.float64)
    _, normal = mesh.areas_and_normals()
    ground = (mesh.class_id == CLASS_NAMES.index("ground")) & (normal[:, 2] > 0.9)
    if not ground.any():
        raise ModelError(
            f"{path} tells no way to walk; add nodes path_1, path_2 ... or name the floor ground"
        )
    area, _ = mesh.areas_and_normals()
    heights = corners[ground][:, :, 2].mean(axis=1)
    order = np.argsort(heights)
    half = np.searchsorted(np.cumsum(area[ground][order]), area[ground].sum() / 2)
    floor = float(heights[order][half])
    origin = corners[:, :, :2].reshape(-1, 2).min(axis=0)
    size = tuple((np.ptp(corners[:, :, :2].reshape(-1, 2), axis=0) / _CELL_M).astype(int)[::-1] + 3)
    level = ground & (np.abs(corners[:, :, 2].mean(axis=1) - floor) < 0.15)
    low, high = corners[:, :, 2].min(axis=1), corners[:, :, 2].max(axis=1)
    free = _drawn(corners[level], origin, size) & ~_drawn(
        corners[(high > floor + 0.2) & (low < floor + _HEAD_M)], origin, size
    )
    room = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * _CELL_M > _FREE_M + _CELL_M
    pieces, count = ndimage.label(room)
    if count:
        largest = 1 + int(np.argmax(ndimage.sum_labels(room, pieces, np.arange(1, count + 1))))
        outlines, _ = cv2.findContours(
            (pieces == largest).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        line = np.asarray(max(outlines, key=len), np.float64)[:, 0] * _CELL_M + origin
        loop = np.column_stack([line, np.full(len(line), floor + EYE_M)])
        if len(loop) > 3:
            soft = rounded_loop(loop, 0.8)
            if np.linalg.norm(np.diff(soft, axis=0), axis=1).sum() > _LEAST_LOOP_M:
                return soft
    raise ModelError(f"{path} has no free ground for a walk; add nodes path_1, path_2 ... at eye height")


def _drawn(
    corners: F64, origin: F64, size: tuple[int, ...]
) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Cells that any of the triangles covers, seen from above."""
    picture = np.zeros(size, np.uint8)
    pixels: I32 = np.rint((corners[:, :, :2] - origin) / _CELL_M).astype(np.int32)
    for triangle in pixels:
        cv2.fillConvexPoly(picture, triangle, 1)
    return picture > 0
