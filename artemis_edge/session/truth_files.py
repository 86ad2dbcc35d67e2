"""Writes the truth of a virtual session: ``truth/`` beside the recording, never in it.

Poses, the world's mesh, the surfaces that the LiDAR observed, what moved, the class of every recorded point.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from artemis_drivers.virtual.lidar import Frame
from artemis_drivers.virtual.mesh_builder import WorldMesh
from artemis_drivers.virtual.observable import HitStore, ObservedSurface, observed_surface, witnesses
from artemis_drivers.virtual.scene import Scene
from artemis_drivers.virtual.world import World

from artemis_edge.export.atomic import replacing, write_bytes
from artemis_edge.export.mesh import vertex_normals
from artemis_edge.frames import F32, F64, I32, U8, Trajectory
from artemis_edge.session.rig import FRAME_NS, START_NS, T_IMU_LIDAR, T_LIDAR_CAM, Rig
from artemis_edge.session.writer import SessionWriter
from artemis_edge.trajectory import write_tum

TRUTH_HZ = 400
POINTS_TOPIC = "/truth/points"
#: A row of truth/points.mcap for every point of the cloud of the same stamp, in the same order.
POINT_TRUTH = np.dtype([("label", "u1"), ("moving", "u1"), ("mixed", "u1"), ("instance", "<i4")])
#: Rows of reference.ply: (vx, vy, vz) is the unit direction to a place from which a beam saw the point.
REFERENCE_POINT = np.dtype(
    [("position", "<f4", 3), ("normal", "<f4", 3), ("view", "<f4", 3), ("label", "u1"), ("instance", "<i4")]
)
_MOVING_POINT = np.dtype([("position", "<f4", 3), ("label", "u1"), ("instance", "<i4")])
_MESH_VERTEX = np.dtype(
    [
        ("position", "<f4", 3),
        ("normal", "<f4", 3),
        ("colour", "u1", 3),
        ("label", "u1"),
        ("confidence", "<f4"),
        ("instance", "<i4"),
    ]
)
_FACE = np.dtype([("count", "u1"), ("vertex", "<i4", 3)])
_PROPERTIES = {
    "position": ("float", ("x", "y", "z")),
    "normal": ("float", ("nx", "ny", "nz")),
    "view": ("float", ("vx", "vy", "vz")),
    "colour": ("uchar", ("red", "green", "blue")),
    "label": ("uchar", ("label",)),
    "confidence": ("float", ("confidence",)),
    "instance": ("int", ("instance",)),
}


@dataclass(slots=True)
class Witness:
    """Watches the recording and keeps of every frame what its truth is made of.

    ``still`` and ``moving`` remember, thinned, what beams met of that which stands and that which moves;
    ``writer`` takes the classes of the points as they come. Either may be left out.
    """

    keep_hits: bool
    writer: SessionWriter | None
    still: HitStore = field(default_factory=HitStore)
    moving: HitStore = field(default_factory=HitStore)
    _scene: Scene | None = None
    _witness: I32 = field(default_factory=lambda: np.empty(0, np.int32))

    def watch(self, frame: Frame, scene: Scene, k: int) -> None:
        """Take in frame ``k``."""
        instance = scene.instance[frame.triangle]
        moves = frame.triangle >= len(scene.mesh.triangles)
        if self.keep_hits:
            met = self._witness_of(scene)[frame.triangle[~moves]]
            self.still.add(frame.hit[~moves], frame.origin[~moves], met)
            self.moving.add(frame.hit[moves], frame.origin[moves], instance[moves])
        if self.writer is not None:
            rows = np.empty(len(instance), POINT_TRUTH)
            rows["label"], rows["instance"] = scene.class_id[frame.triangle], instance
            rows["moving"], rows["mixed"] = moves, frame.mixed
            self.writer.write_cloud(START_NS + k * FRAME_NS, rows, topic=POINTS_TOPIC)

    def _witness_of(self, scene: Scene) -> I32:
        if scene is not self._scene:
            self._scene, self._witness = scene, witnesses(scene.mesh, scene.atlas)
        return self._witness


@dataclass(frozen=True, slots=True)
class Written:
    """How much truth there is."""

    triangles: int
    reference_points: int
    moving_points: int


def write_truth(rig: Rig, frames: int, folder: Path, witness: Witness) -> Written:
    """Write all but the views and the points; raises RunError when the disk refuses."""
    T_session_world = rig.T_session_world()
    _write_trajectories(folder, rig, frames, T_session_world)
    blocks = _blocks_seen(rig, frames)
    triangles = reference = moving = 0
    if rig.settings.mesh:
        mesh = rig.world.mesh(blocks)
        triangles = len(mesh.triangles)
        _write_mesh(folder / "mesh.ply", mesh, rig.world, T_session_world)
    if witness.keep_hits:
        pieces = _observed(rig, blocks, witness.still)
        reference = _write_reference(folder / "reference.ply", pieces, rig.world, T_session_world)
        moving = _write_moving(folder / "moving.ply", witness.moving, rig.world, T_session_world)
    _write_world_json(folder / "world.json", rig, frames, T_session_world)
    return Written(triangles, reference, moving)


def _write_trajectories(folder: Path, rig: Rig, frames: int, T_session_world: F64) -> None:
    for name, rate in (("trajectory.tum", 10), ("trajectory_400hz.tum", TRUTH_HZ)):
        count = frames if rate == 10 else frames * TRUTH_HZ // 10 + 1
        number = np.arange(count)
        poses = T_session_world @ rig.motion.pose(number / rate) @ T_IMU_LIDAR
        write_tum(folder / name, Trajectory(START_NS + number * (1_000_000_000 // rate), poses))


def _blocks_seen(rig: Rig, frames: int) -> range:
    x = rig.motion.position(np.arange(frames + 1) * FRAME_NS / 1e9)[:, 0]
    first = rig.world.blocks_near(float(x.min()), rig.settings.reach_m)
    last = rig.world.blocks_near(float(x.max()), rig.settings.reach_m)
    return range(first.start, last.stop)


def _observed(rig: Rig, blocks: range, store: HitStore) -> Iterator[ObservedSurface]:
    """The observed surface block by block, so that a long walk's does not fill the memory."""
    for k in blocks:
        scene = rig.window.at(float(rig.world.block_edges[k : k + 2].mean()))
        yield observed_surface(rig.world.build_block(k), scene, store, rig.settings.reference_spacing_m)


def label_names(world: World) -> dict[int, str]:
    """Class names by label; what has none of them is 0."""
    return {k: name for k, name in enumerate(world.class_names) if k > 0}


def _moved(points: F32 | F64, T: F64) -> F32:
    out = points @ T[:3, :3].T.astype(points.dtype)
    out += T[:3, 3].astype(points.dtype)
    return np.asarray(out, np.float32)


def _header(world: World, rows: np.dtype[Any], count: int, faces: int | None = None) -> bytes:
    """PLY header of vertices of a dtype whose fields are in _PROPERTIES."""
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment label {k} {name}" for k, name in label_names(world).items()]
    lines.append(f"element vertex {count}")
    for group in rows.names or ():
        kind, names = _PROPERTIES[group]
        lines += [f"property {kind} {name}" for name in names]
    if faces is not None:
        lines += [f"element face {faces}", "property list uchar int vertex_indices"]
    return "\n".join([*lines, "end_header\n"]).encode()


def _write_mesh(path: Path, mesh: WorldMesh, world: World, T_session_world: F64) -> None:
    """The world's surfaces as a mesh of the output contract, with instances; a vertex belongs to one solid."""
    rows = np.zeros(len(mesh.vertices), _MESH_VERTEX)
    rows["position"] = _moved(mesh.vertices, T_session_world)
    rows["normal"] = vertex_normals(rows["position"], mesh.triangles)
    rows["confidence"] = 1.0
    luma = world.atlas.arrays.mean_luma[mesh.material][:, None] / 255.0
    rows["colour"][mesh.triangles] = (mesh.tint * luma).astype(np.uint8)[:, None]
    rows["label"][mesh.triangles] = mesh.class_id[:, None]
    rows["instance"][mesh.triangles] = mesh.instance[:, None]
    faces = np.empty(len(mesh.triangles), _FACE)
    faces["count"], faces["vertex"] = 3, mesh.triangles
    with replacing(path) as file:
        file.write(_header(world, _MESH_VERTEX, len(rows), len(faces)))
        file.write(rows.tobytes())
        file.write(faces.tobytes())


def _write_reference(path: Path, pieces: Iterator[ObservedSurface], world: World, T: F64) -> int:
    """Rows go to a scratch file first: how many there are, which the header says, is known only then."""
    count = 0
    with replacing(path) as file, tempfile.TemporaryFile(dir=path.parent) as body:
        for surface in pieces:
            rows = np.empty(len(surface.points), REFERENCE_POINT)
            rows["position"] = _moved(surface.points, T)
            rows["normal"] = surface.normals @ T[:3, :3].T.astype(np.float32)
            rows["view"] = surface.views @ T[:3, :3].T.astype(np.float32)
            rows["label"], rows["instance"] = surface.labels, surface.instance
            body.write(rows.tobytes())
            count += len(rows)
        file.write(_header(world, REFERENCE_POINT, count))
        body.seek(0)
        shutil.copyfileobj(body, file, 1 << 20)
    return count


def _write_moving(path: Path, store: HitStore, world: World, T: F64) -> int:
    """Where beams met what moves: not part of the reference, because it was elsewhere at other times."""
    rows = np.empty(len(store.hit), _MOVING_POINT)
    rows["position"] = _moved(store.hit, T)
    rows["label"], rows["instance"] = _mover_labels(world, store.instance), store.instance
    write_bytes(path, _header(world, _MOVING_POINT, len(rows)) + rows.tobytes())
    return len(rows)


def _mover_labels(world: World, instance: I32) -> U8:
    """Class of each of the movers' instances."""
    if len(instance) == 0:
        return np.empty(0, np.uint8)
    known = np.concatenate([m.mesh.instance for m in world.movers])
    label = np.concatenate([m.mesh.class_id for m in world.movers])
    number, first = np.unique(known, return_index=True)
    return label[first[np.searchsorted(number, instance)]]


def _write_world_json(path: Path, rig: Rig, frames: int, T_session_world: F64) -> None:
    content = {
        "world": rig.world_name,
        "seed": rig.seed,
        "lidar": rig.sensor_name,
        "seconds": frames * FRAME_NS / 1e9,
        "classes": label_names(rig.world),
        "settings": msgspec.to_builtins(rig.settings),
        "T_session_world": T_session_world.tolist(),
        "T_lidar_cam": T_LIDAR_CAM.tolist(),
        "T_imu_lidar": T_IMU_LIDAR.tolist(),
        "sun": (T_session_world[:3, :3] @ rig.world.sun).tolist(),
    }
    write_bytes(path, (json.dumps(content, indent=1) + "\n").encode())
