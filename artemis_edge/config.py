"""Every parameter of the system: declared once, with its unit, range and reason.

A profile (``artemis_edge/profiles/*.toml``) or a user's file overrides defaults, ``--set section.field=value``
overrides both, and the effective values are written beside the results as ``config.toml``.
``docs/tuning.md`` lists these descriptions.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import msgspec
import tomli_w
from msgspec import Meta, Struct

from artemis_edge.errors import InputError


def _float(text: str, *, ge: float | None = None, gt: float | None = None, le: float | None = None) -> Meta:
    bounds = {"ge": ge, "gt": gt, "le": le}
    return Meta(description=text, **{k: v for k, v in bounds.items() if v is not None})  # type: ignore[call-overload,no-any-return]


class OdometryConfig(Struct, frozen=True, forbid_unknown_fields=True):
    """Odometry, used when no poses are given (section III-A of the paper, odometry/)."""

    voxel_m: Annotated[float, _float("Edge of the finest voxel that holds a plane, m.", ge=0.05, le=5.0)] = (
        0.5
    )
    levels: Annotated[int, Meta(description="Sizes of voxel planes, each twice the last.", ge=1, le=6)] = 4
    max_voxels: Annotated[
        int,
        Meta(
            description="Voxels of all sizes in the local map; about 250 bytes each.",
            ge=10_000,
            le=10_000_000,
        ),
    ] = 300_000
    insert_m: Annotated[
        float, _float("Spacing of the points that a scan adds to the local map, m.", ge=0.01, le=2.0)
    ] = 0.15
    points: Annotated[
        int,
        Meta(
            description="Points of a scan that are registered, about; more are slower.", ge=200, le=1_000_000
        ),
    ] = 4000
    min_range_m: Annotated[
        float,
        _float(
            "Nearer points belong to the operator or the vehicle and are not registered, m.", ge=0.0, le=100.0
        ),
    ] = 0.5
    max_range_m: Annotated[
        float,
        _float("Farther points are not registered, and farther voxels are forgotten, m.", gt=1.0, le=1000.0),
    ] = 100.0
    sigma_m: Annotated[
        float, _float("Noise of one measured point along the surface normal, m.", ge=0.001, le=1.0)
    ] = 0.03
    acceleration: Annotated[
        float, _float("What the sensor's carrier may do to its velocity, m/s2.", ge=0.01, le=1000.0)
    ] = 3.0
    angular_acceleration: Annotated[
        float, _float("What the sensor's carrier may do to its turn rate, rad/s2.", ge=0.01, le=1000.0)
    ] = 6.0
    start_speed: Annotated[
        float,
        _float("How fast the sensor may already move when the recording starts, m/s.", ge=0.01, le=1000.0),
    ] = 15.0
    start_turn: Annotated[
        float,
        _float("How fast the sensor may already turn when the recording starts, rad/s.", ge=0.001, le=100.0),
    ] = 0.5
    gyro_sigma: Annotated[
        float,
        _float("Error of a slow gyroscope, bias included, where no filter runs, rad/s.", ge=1e-5, le=10.0),
    ] = 0.02
    gyro_noise: Annotated[
        float, _float("White noise of the gyroscope in the filter, rad/s/sqrt(Hz).", ge=1e-6, le=1.0)
    ] = 1e-3
    accel_noise: Annotated[
        float, _float("White noise of the accelerometer in the filter, m/s2/sqrt(Hz).", ge=1e-5, le=10.0)
    ] = 1e-2
    gyro_walk: Annotated[
        float, _float("Random walk of the gyroscope's bias, rad/s2/sqrt(Hz).", ge=1e-8, le=1.0)
    ] = 2e-5
    accel_walk: Annotated[
        float, _float("Random walk of the accelerometer's bias, m/s3/sqrt(Hz).", ge=1e-8, le=10.0)
    ] = 3e-4
    visual: Annotated[
        bool, Meta(description="Whether images correct the filter, where the rig has cameras and an IMU.")
    ] = True
    close_loops: Annotated[
        bool,
        Meta(
            description="Whether reprocess looks for places seen again and corrects the poses (extra loop)."
        ),
    ] = False


class VoxelMapConfig(Struct, frozen=True, forbid_unknown_fields=True):
    """Voxel grid that scans are allocated to (section III-B, voxel_map.py)."""

    voxel_m: Annotated[
        float,
        _float("Edge of a voxel [m]; the point spacing r is a quarter of it.", ge=0.08, le=4.0),
    ] = 0.4
    min_range_m: Annotated[
        float, _float("Points nearer than this are the operator or the housing [m].", ge=0.0, le=10.0)
    ] = 0.8
    max_range_m: Annotated[
        float,
        _float("Points farther than this are not mapped: they weigh less than 0.1 [m].", ge=0.1, le=1000.0),
    ] = 60.0
    noise_range_m: Annotated[
        float,
        _float(
            "Range where the error from beam angle equals the ranging error: 2 cm / 1 mrad [m].",
            ge=0.1,
            le=100_000.0,
        ),
    ] = 20.0
    degenerate_trust: Annotated[
        float,
        _float(
            "Share that a point counts where its frame's scan leaves a direction of travel open.",
            ge=0.05,
            le=1.0,
        ),
    ] = 0.5
    plane_sigma_m: Annotated[
        float,
        _float("Thickness up to which points are one plane: ranging noise 1 sigma [m].", ge=0.0001, le=0.5),
    ] = 0.02
    free_space: Annotated[
        bool, Meta(description="Whether vertices that later scans look through are removed.")
    ] = True
    dynamic_filter: Annotated[
        bool,
        Meta(
            description="Whether earlier scans are asked, too, and movable things that were looked through are removed."
        ),
    ] = False
    free_space_range_m: Annotated[
        float, _float("How far around the sensor vertices are judged by free space [m].", ge=0.1, le=200.0)
    ] = 30.0
    free_space_slope: Annotated[
        float,
        _float("Share of the range by which a look must miss a vertex, besides a voxel.", ge=0.0, le=0.2),
    ] = 0.02
    memory_budget_mb: Annotated[
        int,
        Meta(
            description="Resident memory of the whole process; beyond it blocks go to disk [MB].",
            ge=600,
            le=1_000_000,
        ),
    ] = 2000


class MesherConfig(Struct, frozen=True, forbid_unknown_fields=True):
    """Incremental meshing of active voxels (section III-B, mesher.py)."""

    min_distance: Annotated[
        float, _float("Vertices nearer than this share of the point spacing are merged.", ge=0.0, le=1.0)
    ] = 0.5
    least_evidence: Annotated[
        float,
        _float(
            "Evidence within one and a half spacings that makes a vertex (1: one hit close by).",
            ge=0.0,
            le=1000.0,
        ),
    ] = 1.0
    short_edge: Annotated[
        float, _float("Edges up to this many point spacings are surface.", ge=1.0, le=4.0)
    ] = 2.0
    long_edge: Annotated[
        float, _float("Edges up to this many point spacings are surface where well seen.", ge=1.0, le=4.0)
    ] = 4.0
    least_hits: Annotated[
        float,
        _float(
            "Hits of a triangle's corners (far ones count more) that carry a short edge, a longer one by its square.",
            ge=0.0,
            le=1000.0,
        ),
    ] = 6.0
    agreement: Annotated[
        float,
        _float(
            "Least cosine between a triangle's normal and its vertices'; -1 accepts all.", ge=-1.0, le=1.0
        ),
    ] = -1.0
    group_cosine: Annotated[
        float,
        _float(
            "Vertices whose normal is this near to a voxel's direction are meshed together.", ge=-1.0, le=1.0
        ),
    ] = 0.3
    wait_frames: Annotated[
        int, Meta(description="Frames a voxel collects evidence before its first patch.", ge=0, le=100)
    ] = 3
    longest_wait_frames: Annotated[
        int, Meta(description="Frames after which a waiting voxel is meshed or let go.", ge=1, le=1000)
    ] = 20
    fresh: Annotated[
        int, Meta(description="A patch is made anew when this many vertices are new.", ge=1, le=1000)
    ] = 4
    growth: Annotated[
        float,
        _float(
            "A patch is made anew when its evidence grew by this factor (3: noise halves).",
            ge=0.01,
            le=1000.0,
        ),
    ] = 3.0
    most_voxels: Annotated[
        int, Meta(description="Voxels meshed in one frame at most; the rest waits.", ge=1, le=1_000_000)
    ] = 500
    smallest_island: Annotated[
        int,
        Meta(description="Islands of fewer triangles are left out of the finished mesh.", ge=1, le=1_000_000),
    ] = 4


class SemanticsConfig(Struct, frozen=True, forbid_unknown_fields=True):
    """Classes in the map: fusion, constraint and refinement (eqs 1 to 8, 12, 13; docs/semantics.md)."""

    reach_m: Annotated[float, _float("How far from the camera masks are believed [m].", ge=1.0, le=200.0)] = (
        40.0
    )
    sigma_d_m: Annotated[
        float, _float("sigma_d of eq. 1: depth uncertainty that costs a factor e [m].", ge=0.01, le=10.0)
    ] = 0.15
    confidence_rate: Annotated[
        float, _float("lambda of eq. 7: how fast observations make a voxel confident.", ge=0.001, le=100.0)
    ] = 0.5
    constraint: Annotated[bool, Meta(description="Whether vertices move by eqs 2 to 8.")] = True
    sim_semantic: Annotated[
        bool, Meta(description="Whether eq. 5 weakens smoothing between classes; off: sim = 1.")
    ] = True
    lambda_sem: Annotated[
        float,
        _float("Weight of E_semantic in eq. 2; 0 leaves edges between objects alone.", ge=0.0, le=100.0),
    ] = 1.0
    lambda_smooth: Annotated[float, _float("Weight of E_smoothness in eq. 2.", ge=0.0, le=100.0)] = 0.1
    temperature: Annotated[float, _float("tau of eq. 5.", ge=0.0, le=100.0)] = 4.0
    sweeps: Annotated[int, Meta(description="Gauss-Seidel sweeps of the constraint.", ge=1, le=20)] = 3
    refinement: Annotated[
        bool, Meta(description="Whether vertices refine their classes by eqs 12 and 13.")
    ] = True
    sigma_geom: Annotated[
        float, _float("sigma_geom of eq. 9 for classes: relative depth error.", ge=0.001, le=1.0)
    ] = 0.03
    agreement: Annotated[
        float,
        _float(
            "How much vertices of one surface give way to each other's classes in the finished mesh; 0: not.",
            ge=0.0,
            le=100.0,
        ),
    ] = 3.0
    spread_rings: Annotated[
        int,
        Meta(
            description="Edges that a class reaches beyond what images saw, in the finished mesh.",
            ge=0,
            le=100,
        ),
    ] = 10


class InputConfig(Struct, frozen=True, forbid_unknown_fields=True):
    """Which topics of a bag are read, where it holds more than one of a kind (datasets/rosbag.py)."""

    lidar_topics: Annotated[
        tuple[str, ...],
        Meta(
            description="Cloud topics, the primary LiDAR first; empty: one for each LiDAR frame of the bag."
        ),
    ] = ()
    image_topics: Annotated[
        tuple[str, ...], Meta(description="Image topics; empty: one for each camera frame of the bag.")
    ] = ()
    imu_topic: Annotated[str, Meta(description="IMU topic; empty: the first by name.")] = ""
    odometry_topic: Annotated[
        str,
        Meta(description="Odometry topic whose poses are used where tf has none; empty: the first by name."),
    ] = ""
    calibration: Annotated[
        str,
        Meta(
            description="File of calibrate: mounts, lenses and time offsets instead of the recording's own."
        ),
    ] = ""


class ExclusionConfig(Struct, frozen=True, forbid_unknown_fields=True):
    """Zones that move with the scanner and belong to the operator, a tripod or the vehicle (exclusion.py).

    In the frame of the primary LiDAR, x ahead, z up, m. Their points are counted as `operator_points` and not used.
    """

    behind_m: Annotated[
        float,
        _float("Points nearer than this behind the scanner are the operator; 0: none [m].", ge=0.0, le=10.0),
    ] = 0.0
    behind_deg: Annotated[
        float, _float("Width of the sector that is behind, around -x [degrees].", ge=1.0, le=360.0)
    ] = 120.0
    boxes: Annotated[
        tuple[tuple[float, float, float, float, float, float], ...],
        Meta(description="Boxes: x_min, y_min, z_min, x_max, y_max, z_max."),
    ] = ()
    cylinders: Annotated[
        tuple[tuple[float, float, float, float, float], ...],
        Meta(description="Upright cylinders: x, y, radius, z_min, z_max."),
    ] = ()


class RefinementConfig(Struct, frozen=True, forbid_unknown_fields=True):
    """Texture from photographs, weighed by reliability (section III-C, refinement/)."""

    enabled: Annotated[bool, Meta(description="Whether images colour the map.")] = True
    sigma_photo: Annotated[
        float,
        _float("Colour difference that halves trust, about (eq. 9) [grey levels].", ge=0.1, le=1e6),
    ] = 80.0
    sigma_geom: Annotated[
        float,
        _float("Distance in front of a surface that halves trust (eq. 9) [share of it].", ge=1e-4, le=1e6),
    ] = 0.05
    least_reliability: Annotated[
        float, _float("Observations of less reliability W are discarded.", ge=0.001, le=0.999)
    ] = 0.1
    noise: Annotated[
        float,
        _float(
            "How colours of one place differ between good images, 1 sigma [grey levels].", ge=0.1, le=255.0
        ),
    ] = 20.0
    most_information: Annotated[
        float, _float("Good observations that a colour remembers at most.", ge=1.0, le=63.0)
    ] = 16.0
    forget: Annotated[
        float, _float("Share of its information that a contradicted colour loses.", ge=0.0, le=0.9)
    ] = 0.2
    least_cosine: Annotated[
        float,
        _float("Surfaces seen at a smaller cosine of the viewing angle are left alone.", ge=0.01, le=0.99),
    ] = 0.03
    range_m: Annotated[
        float, _float("Surfaces farther than this are not coloured [m].", ge=1.0, le=1000.0)
    ] = 80.0
    texel_px: Annotated[
        float, _float("Edge of a texel at most, in pixels of the closest image.", ge=0.25, le=64.0)
    ] = 1.4
    finest_texel_m: Annotated[float, _float("Texels are never smaller than this [m].", ge=0.001, le=1.0)] = (
        0.00625
    )
    texel_share: Annotated[
        float, _float("Share of the map's memory that texels may take.", ge=0.05, le=0.9)
    ] = 0.6
    atlas_megatexels: Annotated[
        float, _float("Texels of the finished mesh's atlas at most [millions].", ge=0.1, le=4096.0)
    ] = 128.0
    vignetting: Annotated[
        bool, Meta(description="Whether the fall-off of lenses towards their corners is undone.")
    ] = True
    most_texels: Annotated[
        int,
        Meta(
            description="Texels that one image colours while the map grows; each takes about 60 ns.",
            ge=1000,
            le=100_000_000,
        ),
    ] = 60_000
    most_triangles: Annotated[
        int,
        Meta(
            description="Triangles that one image is compared with while the map grows, the nearest in view; each takes"
            " about 100 ns.",
            ge=1000,
            le=100_000_000,
        ),
    ] = 120_000
    alternate: Annotated[
        bool,
        Meta(
            description="While the map grows use every second image where a camera hardly moves between them,"
            " and colour twice as much with it."
        ),
    ] = True
    wait_frames: Annotated[
        int, Meta(description="Frames after which an image is used, if its surface is meshed.", ge=0, le=1000)
    ] = 6
    patience_frames: Annotated[
        int, Meta(description="Frames after which it is used in any case.", ge=0, le=10_000)
    ] = 50
    keyframes: Annotated[
        int,
        Meta(description="Images kept for what is meshed after they were used.", ge=0, le=10_000),
    ] = 150


class KeepConfig(Struct, frozen=True, forbid_unknown_fields=True):
    """What of the input stays in ``map/`` for exports and for ``evaluate texture`` (keeper.py)."""

    points: Annotated[
        int,
        Meta(
            description="Points at most, 22 bytes each; beyond it every second one goes.",
            ge=0,
            le=100_000_000,
        ),
    ] = 6_000_000
    images: Annotated[
        int,
        Meta(description="Images at most; beyond it every second one goes.", ge=0, le=100_000),
    ] = 300


class SegmentationConfig(Struct, frozen=True, forbid_unknown_fields=True):
    """Segmentation of images by words (section III-B, segmentation/; docs/models.md)."""

    model: Annotated[
        str,
        Meta(description="Registered model; empty: the user's only one, else the one that ships."),
    ] = ""
    least_score: Annotated[
        float, _float("Instances of less probability are not found.", ge=0.01, le=0.99)
    ] = 0.25
    overlap: Annotated[
        float, _float("Boxes that share more than this (IoU) are one object.", ge=0.05, le=0.99)
    ] = 0.7
    most_hz: Annotated[
        float,
        _float("Images a second of one camera that are segmented live; 0: all [Hz].", ge=0.0, le=1000.0),
    ] = 0.0
    every: Annotated[
        int, Meta(description="In reprocess, images of every so many frames are segmented.", ge=1, le=1000)
    ] = 2
    delay_frames: Annotated[
        int, Meta(description="In reprocess, frames after which a mask is fused.", ge=1, le=1000)
    ] = 3
    keyframe_m: Annotated[
        float, _float("Photographs kept for later questions are so far apart [m].", ge=0.01, le=1000.0)
    ] = 0.5
    keyframe_deg: Annotated[float, _float("Or turned by so much [degrees].", ge=0.1, le=180.0)] = 15.0
    keyframes_mb: Annotated[
        int, Meta(description="What they may take on disk; 0: none is kept [MB].", ge=0, le=1_000_000)
    ] = 200


class ViewConfig(Struct, frozen=True, forbid_unknown_fields=True):
    """The map of a `reprocess` as it grows, for `artemis-edge view --live` in another process (telling.py)."""

    socket: Annotated[str, Meta(description="Unix socket to tell changes on; empty: nobody is told.")] = ""


class Config(Struct, frozen=True, forbid_unknown_fields=True):
    """The whole configuration: one section a stage."""

    input: InputConfig = InputConfig()
    exclusion: ExclusionConfig = ExclusionConfig()
    odometry: OdometryConfig = OdometryConfig()
    voxel_map: VoxelMapConfig = VoxelMapConfig()
    mesher: MesherConfig = MesherConfig()
    refinement: RefinementConfig = RefinementConfig()
    keep: KeepConfig = KeepConfig()
    view: ViewConfig = ViewConfig()
    segmentation: SegmentationConfig = SegmentationConfig()
    semantics: SemanticsConfig = SemanticsConfig()


# Settings of earlier versions, which their recordings and maps still carry
_RETIRED = {"mesher": ("coplanar", "well_seen")}


def _without_retired(tree: dict[str, Any]) -> dict[str, Any]:
    kept = dict(tree)
    for name, fields in _RETIRED.items():
        if isinstance(section := tree.get(name), dict):
            kept[name] = {field: value for field, value in section.items() if field not in fields}
    return kept


def load(file: Path | None = None, profile: str | None = None, sets: Iterable[str] = ()) -> Config:
    """Effective configuration: defaults, then the profile, then the file, then ``section.field=value`` texts.

    Retired settings of a file are passed over. Raises InputError naming the field and what it accepts.
    """
    tree: dict[str, Any] = {}
    if profile is not None:
        _merge(tree, _read_profile(profile))
    if file is not None:
        _merge(tree, _without_retired(read_toml(file)))
    for text in sets:
        _merge(tree, _parse_set(text))
    try:
        return msgspec.convert(tree, Config)
    except msgspec.ValidationError as error:
        raise InputError(f"configuration: {error}; docs/tuning.md lists every field and its range") from None


def to_toml(config: Config) -> str:
    """The effective configuration as TOML text."""
    return tomli_w.dumps(msgspec.to_builtins(config))


def from_toml(text: str) -> Config:
    """Inverse of ``to_toml``, retired settings passed over; InputError for a text that is none."""
    try:
        return msgspec.convert(_without_retired(tomllib.loads(text)), Config)
    except (msgspec.MsgspecError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"configuration: {error}; docs/tuning.md lists every field and its range") from None


def without_none(value: Any) -> Any:
    """The same values without those that are none, which TOML cannot say."""
    if isinstance(value, dict):
        return {key: without_none(item) for key, item in value.items() if item is not None}
    return [without_none(item) for item in value] if isinstance(value, list | tuple) else value


def profiles() -> list[str]:
    """Names of the profiles that ship with the program."""
    folder = resources.files("artemis_edge") / "profiles"
    return sorted(p.name.removesuffix(".toml") for p in folder.iterdir() if p.name.endswith(".toml"))


def _read_profile(name: str) -> dict[str, Any]:
    if name not in profiles():
        raise InputError(f"no profile named '{name}'; there are: {', '.join(profiles()) or 'none'}")
    return tomllib.loads((resources.files("artemis_edge") / "profiles" / f"{name}.toml").read_text())


def read_toml(file: Path) -> dict[str, Any]:
    """A file of settings as plain values; InputError where it cannot be read or is no TOML."""
    try:
        return tomllib.loads(file.read_text())
    except OSError as error:
        raise InputError(f"cannot read configuration {file}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{file} is not valid TOML: {error}") from None


def _parse_set(text: str) -> dict[str, Any]:
    key, equals, value = text.partition("=")
    section, dot, field = key.strip().partition(".")
    if not (equals and dot and section and field):
        raise InputError(f"--set {text}: write it as section.field=value, for example voxel_map.voxel_m=0.4")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        parsed = value
    return {section: {field: parsed}}


def _merge(into: dict[str, Any], other: dict[str, Any]) -> None:
    for key, value in other.items():
        if isinstance(value, dict) and isinstance(into.get(key), dict):
            _merge(into[key], value)
        else:
            into[key] = value
