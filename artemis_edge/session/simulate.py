"""``artemis-edge simulate``: a walk through a virtual world, written as a session with its ground truth.

The session's world frame is the first LiDAR frame, levelled; the walk begins exactly level, so that the frame
is the same for odometry with and without an IMU. Ground truth lies in ``truth/`` beside the recording, never
in it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from artemis_drivers.virtual import avia, street
from artemis_drivers.virtual.camera import CameraSpec, Photo, VirtualCamera
from artemis_drivers.virtual.imu import ImuRecord, ImuSpec, measure
from artemis_drivers.virtual.lidar import Frame, LidarSpec, Pattern, scan
from artemis_drivers.virtual.mesh_builder import WorldMesh
from artemis_drivers.virtual.motion import Motion
from artemis_drivers.virtual.observable import HitStore, ObservedSurface, observed_surface
from artemis_drivers.virtual.scene import Scene, Window
from artemis_drivers.virtual.walk import Gait, path_needed_m, walk
from artemis_drivers.virtual.world import World
from msgspec import Meta, Struct
from scipy.spatial.transform import Rotation

from artemis_edge.errors import InputError
from artemis_edge.export.atomic import replacing, write_bytes
from artemis_edge.export.ply import bare_mesh, write_ply
from artemis_edge.frames import F32, F64, CameraModel, Trajectory
from artemis_edge.session.writer import SessionWriter
from artemis_edge.trajectory import inverse, write_tum

START_NS = 1_000_000_000_000  # session time of the first frame: not 0, so that "absent" is not taken for it
FRAME_NS = 100_000_000
WORLDS = ("street",)
LIDARS: dict[str, Pattern] = {"avia": avia.beams}
_TRUTH_HZ = 400
_LONG_WALK_S = 300.0

#: Called with (frames done, frames in all).
Progress = Callable[[int, int], None]

# FAST-LIVO2 avia.yaml: position of the LiDAR in the axes of the Avia's own IMU, metres.
T_IMU_LIDAR = np.array([[1, 0, 0, 0.04165], [0, 1, 0, 0.02326], [0, 0, 1, -0.0284], [0, 0, 0, 1.0]])


def _camera_mount() -> F64:
    """T_lidar_cam: optical axes (z forward, y down), 6 cm below the LiDAR, half a degree off square."""
    T = np.eye(4)
    axes = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    T[:3, :3] = Rotation.from_euler("zyx", [0.5, 0.8, -0.4], degrees=True).as_matrix() @ axes
    T[:3, 3] = 0.03, -0.01, -0.06
    return T


T_LIDAR_CAM = _camera_mount()


class Settings(Struct, frozen=True, forbid_unknown_fields=True):
    """What ``--set key=value`` can change."""

    density: Annotated[float, Meta(gt=0, le=1, description="Share of the LiDAR's points that are kept.")] = (
        1.0
    )
    camera: Annotated[bool, Meta(description="Write photographs.")] = True
    camera_every: Annotated[int, Meta(ge=1, description="A photograph every so many LiDAR frames.")] = 1
    image_width: Annotated[int, Meta(ge=64, le=4096, description="Pixels; the height is 0.8 of it.")] = 640
    jpeg_quality: Annotated[int, Meta(ge=1, le=100, description="JPEG quality.")] = 92
    range_noise_m: Annotated[float, Meta(ge=0, description="Range noise at 20 m, one sigma.")] = 0.02
    angular_noise_deg: Annotated[float, Meta(ge=0, description="Direction noise, one sigma.")] = 0.05
    imu: Annotated[bool, Meta(description="Write IMU samples.")] = True
    imu_noise: Annotated[float, Meta(ge=0, description="Factor on all noise and bias of the IMU.")] = 1.0
    speed: Annotated[float, Meta(gt=0, le=3, description="Walking speed, m/s.")] = 1.2
    length: Annotated[float, Meta(ge=0, description="Length of the street, m; 0: as the walk needs.")] = 0.0
    reach_m: Annotated[
        float, Meta(ge=20, le=450, description="How far along the street the world is built.")
    ] = 160.0
    mesh: Annotated[bool, Meta(description="Write truth/mesh.ply.")] = True
    reference: Annotated[
        bool | None, Meta(description="Write truth/reference.ply (default: walks up to 300 s).")
    ] = None
    reference_spacing_m: Annotated[float, Meta(gt=0, description="Spacing of the reference's points.")] = 0.02


@dataclass(frozen=True, slots=True)
class SimulationSummary:
    """What was written, and what was lost: beams that met nothing or too little light are no points."""

    session: Path
    truth: Path
    frames: int
    points: int
    beams: int
    images: int
    imu_samples: int
    length_m: float
    triangles: int
    reference_points: int


@dataclass(slots=True)
class _Rig:
    """Everything that moves through the world."""

    world: World
    motion: Motion
    pattern: Pattern
    pattern_name: str
    lidar: LidarSpec
    imu: ImuRecord | None
    camera: VirtualCamera | None
    settings: Settings
    seed: int
    window: Window = field(init=False)

    def __post_init__(self) -> None:
        self.window = Window(self.world, self.settings.reach_m)

    def camera_pose(self, time_s: float) -> F64:
        """T_world_cam at a time of the walk."""
        pose: F64 = self.motion.pose(time_s)[0] @ T_IMU_LIDAR @ T_LIDAR_CAM
        return pose


def simulate(
    world_name: str,
    seed: int,
    seconds: float,
    lidar: str,
    out: Path,
    settings: dict[str, str] | None = None,
    progress: Progress | None = None,
) -> SimulationSummary:
    """Write the session ``out`` (a directory: session.mcap and truth/) of a walk of ``seconds``.

    Raises InputError for unknown names, settings or impossible lengths, RunError when the disk refuses.
    """
    chosen = _settings(settings or {})
    frames = round(seconds * 1e9 / FRAME_NS)
    if frames < 1:
        raise InputError(f"--seconds {seconds:g} is less than one frame; give 0.1 or more")
    rig = _build_rig(world_name, seed, frames * FRAME_NS / 1e9, lidar, chosen)
    store = HitStore()
    counts = _record(rig, frames, out / "session.mcap", store, progress)
    triangles, reference = _write_truth(rig, frames, out / "truth", store)
    return SimulationSummary(
        session=out,
        truth=out / "truth",
        frames=frames,
        points=counts["points"],
        beams=counts["beams"],
        images=counts["images"],
        imu_samples=counts["imu"],
        length_m=_travelled(rig.motion, frames),
        triangles=triangles,
        reference_points=reference,
    )


def _settings(texts: dict[str, str]) -> Settings:
    words = {"on": "true", "off": "false", "yes": "true", "no": "false"}
    values = {key: words.get(value.lower(), value) for key, value in texts.items()}
    try:
        return msgspec.convert(values, Settings, strict=False)
    except msgspec.ValidationError as error:
        known = ", ".join(Settings.__struct_fields__)
        raise InputError(f"--set of simulate: {error}; there are: {known}") from None


def _build_rig(world_name: str, seed: int, seconds: float, lidar: str, s: Settings) -> _Rig:
    if world_name not in WORLDS:
        raise InputError(f"no virtual world named '{world_name}'; there are: {', '.join(WORLDS)}")
    if lidar not in LIDARS:
        raise InputError(f"no virtual LiDAR named '{lidar}'; there are: {', '.join(LIDARS)}")
    if seed < 0:
        raise InputError(f"--seed {seed} is negative; give 0 or more")
    gait = Gait(speed=s.speed)
    needed = path_needed_m(seconds, gait) + 2 * street.END_MARGIN_M
    if 0 < s.length < needed:
        raise InputError(
            f"a street of {s.length:g} m is too short for this walk; give length={np.ceil(needed):.0f}"
        )
    world = street.build(seed, max(needed, s.length or 100.0))
    # the walk is the IMU's; the LiDAR's axes are parallel to them, so it starts level, too
    motion = walk(world.path, seconds + 0.2, seed, gait)
    imu = measure(motion, ImuSpec().scaled(s.imu_noise), seed, seconds) if s.imu else None
    spec = CameraSpec(jpeg_quality=s.jpeg_quality).scaled(s.image_width)
    camera = VirtualCamera(spec, seed) if s.camera else None
    physics = LidarSpec(range_noise_m=s.range_noise_m, angular_noise=np.radians(s.angular_noise_deg))
    return _Rig(world, motion, LIDARS[lidar], lidar, physics, imu, camera, s, seed)


def _record(rig: _Rig, frames: int, path: Path, store: HitStore, progress: Progress | None) -> dict[str, int]:
    counts = {"points": 0, "beams": 0, "images": 0, "imu": 0}
    wants_reference = _wants_reference(rig.settings, frames)
    with (
        SessionWriter(path, metadata={"simulation": _description(rig)}) as writer,
        ThreadPoolExecutor(1) as photographer,
    ):
        _write_mounts(writer, rig)
        for k in range(frames):
            scene = rig.window.at(float(rig.motion.position(k * 0.1)[0]))
            photo = _start_photo(rig, scene, k, photographer)
            frame = _scan(rig, scene, k)
            if wants_reference:
                store.add(frame.hit, frame.origin, scene.instance[frame.triangle])
            _write_frame(writer, rig, k, frame, photo, counts)
            if progress is not None:
                progress(k + 1, frames)
    return counts


def _start_photo(rig: _Rig, scene: Scene, k: int, pool: ThreadPoolExecutor) -> Future[Photo] | None:
    """The photograph is taken in the middle of the LiDAR's window, on another core while that scans."""
    if rig.camera is None or k % rig.settings.camera_every:
        return None
    return pool.submit(rig.camera.photograph, scene, rig.world.sun, rig.camera_pose, k * 0.1 + 0.05, k)


def _scan(rig: _Rig, scene: Scene, k: int) -> Frame:
    rng = np.random.default_rng([rig.seed, 41, k])
    beams = rig.pattern(k, rig.settings.density)
    return scan(scene, rig.motion, T_IMU_LIDAR, beams, k * 0.1, rig.lidar, rng)


def _write_mounts(writer: SessionWriter, rig: _Rig) -> None:
    writer.write_tf_static(START_NS, "lidar", "cam", T_LIDAR_CAM)
    writer.write_tf_static(START_NS, "imu", "lidar", T_IMU_LIDAR)


def _camera_model(spec: CameraSpec) -> CameraModel:
    return CameraModel(spec.width, spec.height, spec.fx, spec.fy, spec.cx, spec.cy, spec.distortion)


def _write_frame(
    writer: SessionWriter,
    rig: _Rig,
    k: int,
    frame: Frame,
    photo: Future[Photo] | None,
    counts: dict[str, int],
) -> None:
    """Messages of one window in the order in which a host would receive them."""
    stamp = START_NS + k * FRAME_NS
    middle, end = stamp + FRAME_NS // 2, stamp + FRAME_NS
    for sample in _imu_between(rig.imu, k):
        _write_imu(writer, rig.imu, sample, counts)
        if photo is not None and sample == _imu_index(rig.imu, k, 0.5) + 4:
            _write_photo(writer, rig, middle, photo, counts)
            photo = None
    if photo is not None:
        _write_photo(writer, rig, middle, photo, counts)
    writer.write_points(
        stamp,
        frame.points,
        intensity=frame.intensity,
        line=frame.line,
        offset_ns=frame.offset_ns,
        receive_ns=end,
    )
    counts["points"] += len(frame.points)
    counts["beams"] += frame.emitted


def _imu_index(imu: ImuRecord | None, k: int, share: float) -> int:
    """Number of the sample at a share of window k."""
    if imu is None or len(imu.time_s) < 2:
        return 0
    return round((k + share) * 0.1 / float(imu.time_s[1]))


def _imu_between(imu: ImuRecord | None, k: int) -> Iterable[int]:
    if imu is None:
        return ()
    last = k + 1 == round(float(imu.time_s[-1]) * 10)
    return range(_imu_index(imu, k, 0.0), _imu_index(imu, k, 1.0) + (1 if last else 0))


def _write_imu(writer: SessionWriter, imu: ImuRecord | None, sample: int, counts: dict[str, int]) -> None:
    assert imu is not None
    stamp = START_NS + round(float(imu.time_s[sample]) * 1e9)
    writer.write_imu(stamp, imu.gyro[sample], imu.accel[sample])
    counts["imu"] += 1


def _write_photo(
    writer: SessionWriter, rig: _Rig, stamp: int, photo: Future[Photo], counts: dict[str, int]
) -> None:
    assert rig.camera is not None
    received = stamp + 20_000_000  # exposure, readout and transfer
    writer.write_image(stamp, photo.result().data, receive_ns=received)
    writer.write_camera_info(stamp, _camera_model(rig.camera.spec), receive_ns=received)
    counts["images"] += 1


def _description(rig: _Rig) -> dict[str, str]:
    return {"world": rig.world.name, "seed": str(rig.seed), "lidar": rig.pattern_name, **_texts(rig.settings)}


def _texts(settings: Settings) -> dict[str, str]:
    return {name: str(getattr(settings, name)) for name in settings.__struct_fields__}


def _travelled(motion: Motion, frames: int) -> float:
    position = motion.position(np.arange(frames + 1) * 0.1)
    return float(np.linalg.norm(np.diff(position, axis=0), axis=1).sum())


def _wants_reference(settings: Settings, frames: int) -> bool:
    if settings.reference is not None:
        return settings.reference
    return frames * FRAME_NS / 1e9 <= _LONG_WALK_S


def session_from_world(motion: Motion) -> F64:
    """T_session_world: the session's frame is the first LiDAR frame, levelled, with its yaw."""
    T_world_lidar = motion.pose(0.0)[0] @ T_IMU_LIDAR
    x = T_world_lidar[:3, 0]
    yaw = np.arctan2(x[1], x[0])
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = T_world_lidar[:3, 3]
    return inverse(T)


def _write_truth(rig: _Rig, frames: int, folder: Path, store: HitStore) -> tuple[int, int]:
    folder.mkdir(parents=True, exist_ok=True)
    T_session_world = session_from_world(rig.motion)
    for name, rate in (("trajectory.tum", 10), ("trajectory_400hz.tum", _TRUTH_HZ)):
        count = frames if rate == 10 else frames * _TRUTH_HZ // 10 + 1
        number = np.arange(count)
        poses = T_session_world @ rig.motion.pose(number / rate) @ T_IMU_LIDAR
        write_tum(folder / name, Trajectory(START_NS + number * (1_000_000_000 // rate), poses))
    blocks = _blocks_seen(rig, frames)
    triangles = 0
    if rig.settings.mesh:
        mesh = rig.world.mesh(blocks)
        triangles = len(mesh.triangles)
        _write_mesh(folder / "mesh.ply", mesh, rig.world, T_session_world)
    reference = 0
    if _wants_reference(rig.settings, frames):
        surface = _observed(rig, blocks, store)
        reference = len(surface.points)
        _write_reference(folder / "reference.ply", surface, rig.world, T_session_world)
    _write_world_json(folder / "world.json", rig, frames, T_session_world)
    return triangles, reference


def _blocks_seen(rig: _Rig, frames: int) -> range:
    x = rig.motion.position(np.arange(frames + 1) * 0.1)[:, 0]
    first = rig.world.blocks_near(float(x.min()), rig.settings.reach_m)
    last = rig.world.blocks_near(float(x.max()), rig.settings.reach_m)
    return range(first.start, last.stop)


def _observed(rig: _Rig, blocks: range, store: HitStore) -> ObservedSurface:
    parts = []
    for k in blocks:
        scene = rig.window.at(float(rig.world.block_edges[k : k + 2].mean()))
        parts.append(
            observed_surface(rig.world.build_block(k), scene, store, rig.settings.reference_spacing_m)
        )
    return ObservedSurface(
        np.concatenate([p.points for p in parts]),
        np.concatenate([p.normals for p in parts]),
        np.concatenate([p.labels for p in parts]),
        np.concatenate([p.instance for p in parts]),
    )


def _label_names(world: World) -> dict[int, str]:
    return {k: name for k, name in enumerate(world.class_names) if k > 0}


def _moved(points: F32, T: F64) -> F32:
    return np.asarray(points @ T[:3, :3].T + T[:3, 3], np.float32)


def _write_mesh(path: Path, mesh: WorldMesh, world: World, T_session_world: F64) -> None:
    """The world's surfaces as a mesh of the output contract, one vertex per corner of a solid."""
    labels = np.zeros(len(mesh.vertices), np.uint8)
    labels[mesh.triangles] = mesh.class_id[:, None]
    colours = np.zeros((len(mesh.vertices), 3), np.uint8)
    luma = world.atlas.arrays.mean_luma[mesh.material][:, None] / 255.0
    colours[mesh.triangles] = (mesh.tint * luma).astype(np.uint8)[:, None]
    write_ply(
        path,
        bare_mesh(
            _moved(mesh.vertices, T_session_world),
            mesh.triangles,
            colours=colours,
            labels=labels,
            label_names=_label_names(world),
        ),
    )


_REFERENCE_POINT = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("label", "u1")])


def _write_reference(path: Path, surface: ObservedSurface, world: World, T_session_world: F64) -> None:
    comments = "".join(f"comment label {k} {name}\n" for k, name in _label_names(world).items())
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    header = (
        f"ply\nformat binary_little_endian 1.0\n{comments}element vertex {len(surface.points)}\n"
        f"{properties}property uchar label\nend_header\n"
    )
    rows = np.empty(len(surface.points), _REFERENCE_POINT)
    rows["position"] = _moved(surface.points, T_session_world)
    rows["normal"] = surface.normals @ T_session_world[:3, :3].T
    rows["label"] = surface.labels
    with replacing(path) as file:
        file.write(header.encode())
        file.write(rows.tobytes())


def _write_world_json(path: Path, rig: _Rig, frames: int, T_session_world: F64) -> None:
    content = {
        "world": rig.world.name,
        "seed": rig.seed,
        "lidar": rig.pattern_name,
        "seconds": frames * FRAME_NS / 1e9,
        "classes": _label_names(rig.world),
        "settings": msgspec.to_builtins(rig.settings),
        "T_session_world": T_session_world.tolist(),
        "T_lidar_cam": T_LIDAR_CAM.tolist(),
        "T_imu_lidar": T_IMU_LIDAR.tolist(),
    }
    write_bytes(path, (json.dumps(content, indent=1) + "\n").encode())
