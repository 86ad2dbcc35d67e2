"""The sensors of a recording: which topics are used, how they are mounted, and what is left out and why."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from artemis_edge.config import InputConfig
from artemis_edge.datasets.bag_index import CLOUDS, IMAGES, BagIndex, OdometryTrack, Track
from artemis_edge.datasets.cameras import camera_model, encoded_image, info_topics
from artemis_edge.datasets.clouds import CloudFormat, CloudPoints, decode_cloud, point_records, settle_format
from artemis_edge.datasets.common import add_counts
from artemis_edge.errors import InputError
from artemis_edge.frames import F64, I64, Bool, CameraModel, ImuSamples
from artemis_edge.session.cdr import CdrError
from artemis_edge.session.messages import LivoxCustomMsg

_GRAVITY = 9.80665
# A mean acceleration (norm) in here is gravity in units of g, as the Livox driver writes it.
_IN_G = (0.7, 1.5)
# Clouds looked at to settle what the fields of a topic mean: the first ones may be empty or cut.
_TRIALS = 20


@dataclass(frozen=True, slots=True)
class Lidar:
    """A LiDAR: ``T_lidar_sensor`` (n, 4, 4) and whether it is known, for each of its clouds."""

    name: str
    track: Track
    stamp_ns: I64
    format: CloudFormat
    T_lidar_sensor: F64
    known: Bool

    def cloud(self, k: int) -> CloudPoints:
        """The k-th cloud; CdrError if it cannot be decoded."""
        reference = self.track.references[k]
        message = CLOUDS[self.track.ros_type].read(reference.connection.reader(reference.data()))
        return decode_cloud(message, self.format)


@dataclass(frozen=True, slots=True)
class BagCamera:
    """A camera: ``T_cam_lidar`` (n, 4, 4) and whether it is known, for each of its images.

    ``exposure_s`` (n,) is 0 where the recording does not say.
    """

    name: str
    track: Track
    stamp_ns: I64
    model: CameraModel
    T_cam_lidar: F64
    known: Bool
    exposure_s: F64

    def image(self, k: int) -> bytes:
        """The k-th image as a file; CdrError if it cannot be decoded."""
        return _image(self.track, k)


def find_lidars(index: BagIndex, config: InputConfig) -> list[Lidar]:
    """The LiDARs of a recording, the primary one first; InputError if there is none."""
    tracks = _chosen(index, index.clouds, config.lidar_topics, "lidar_topics")
    if not tracks:
        topics = ", ".join(f"{name} ({kind})" for name, kind in sorted(index.types.items())) or "nothing"
        if index.lost.get("truncated_file"):
            raise InputError(
                f"the recording is cut off or damaged, and up to there it holds no LiDAR clouds but {topics}; "
                "copy it again or give one with a LiDAR"
            )
        raise InputError(
            f"the recording holds no LiDAR clouds (PointCloud2 or livox CustomMsg) but {topics}; "
            "give one with a LiDAR"
        )
    if not config.lidar_topics:
        tracks = _one_per_frame(index, _not_of_the_world(index, tracks), "lidar_topics")
    lidars, primary = [], tracks[0].frame_id
    for track in tracks:
        stamps = track.stamp_ns()
        T, known = _mounting(index, primary, track.frame_id, stamps)
        if not known.all():
            _leave_out(index, int((~known).sum()), "clouds_without_mounting", track, primary)
        if known.any():
            lidars.append(Lidar(_name(track, tracks), track, stamps, _format(index, track), T, known))
    return lidars


def find_cameras(index: BagIndex, config: InputConfig, lidar_frame: str) -> list[BagCamera]:
    """The calibrated cameras of a recording whose mounting is known; others are counted, with a warning."""
    tracks = _chosen(index, index.images, config.image_topics, "image_topics")
    if not config.image_topics:
        tracks = [track for track in tracks if not track.topic.endswith("compressedDepth")]
        tracks = _one_per_frame(index, tracks, "image_topics")
    cameras = []
    for track in tracks:
        model = _model(index, track)
        if model is None:
            continue
        stamps = track.stamp_ns()
        T, known = _mounting(index, track.frame_id, lidar_frame, stamps)
        if not known.all():
            _leave_out(index, int((~known).sum()), "images_without_mounting", track, lidar_frame)
        if known.any():
            exposure = np.array([index.exposures.get((track.frame_id, int(stamp)), 0.0) for stamp in stamps])
            cameras.append(BagCamera(_name(track, tracks), track, stamps, model, T, known, exposure))
    return cameras


def find_imu(index: BagIndex, config: InputConfig, lidar_frame: str) -> ImuSamples:
    """Samples of the chosen IMU in order of time, in the axes of the primary LiDAR, m/s2 and rad/s."""
    topic = _first(index, index.imus, config.imu_topic, "imu_topic")
    if topic is None:
        return ImuSamples.empty()
    track = index.imus[topic]
    stamps = track.stamp_ns()
    order = np.argsort(stamps, kind="stable")
    stamps, values = stamps[order], np.array(track.values)[order]
    T_lidar_imu = _imu_mounting(index, topic, track.frame_id, lidar_frame)
    R = T_lidar_imu[:3, :3]
    gyro, accel = values[:, :3] @ R.T, values[:, 3:] @ R.T
    norm = float(np.median(np.linalg.norm(accel, axis=1)))
    if _IN_G[0] < norm < _IN_G[1]:
        index.warnings.append(
            f"the accelerations of {topic} are taken to be in g: their median is {norm:.2f}"
        )
        accel = accel * _GRAVITY
    return ImuSamples(stamps, gyro, accel, T_lidar_imu[:3, 3])


def imu_mounting(index: BagIndex, config: InputConfig, lidar_frame: str) -> F64:
    """T_lidar_imu (4, 4) of the IMU that :func:`find_imu` takes; identity where tf does not say."""
    topic = config.imu_topic or min(index.imus, default="")
    if topic not in index.imus:
        return np.eye(4)
    T, known = _mounting(index, lidar_frame, index.imus[topic].frame_id, np.zeros(1, np.int64))
    return np.array(T[0]) if known.all() else np.eye(4)


def find_odometry(index: BagIndex, config: InputConfig) -> OdometryTrack | None:
    """The chosen Odometry topic."""
    topic = _first(index, index.odometries, config.odometry_topic, "odometry_topic")
    return None if topic is None else index.odometries[topic]


def _chosen(index: BagIndex, tracks: dict[str, Track], wanted: tuple[str, ...], option: str) -> list[Track]:
    """The topics asked for, or all by name."""
    for topic in wanted:
        if topic not in tracks:
            raise InputError(f"the recording has no topic {topic} for input.{option}; it has {_list(tracks)}")
    return [tracks[topic] for topic in wanted or sorted(tracks)]


def _first(index: BagIndex, tracks: Iterable[str], wanted: str, option: str) -> str | None:
    topics = sorted(tracks)
    if wanted and wanted not in topics:
        raise InputError(f"the recording has no topic {wanted} for input.{option}; it has {_list(topics)}")
    if len(topics) > 1 and not wanted:
        index.warnings.append(f"of {_list(topics)} the first is used; choose with --set input.{option}=TOPIC")
    return wanted or (topics[0] if topics else None)


def _list(topics: Iterable[str]) -> str:
    return ", ".join(sorted(topics)) or "none"


def _not_of_the_world(index: BagIndex, tracks: list[Track]) -> list[Track]:
    """Without clouds that are a product: in a frame above that of another cloud (a map)."""
    above = {frame for track in tracks for frame in index.tree.path_up(track.frame_id)[1:]}
    kept = [track for track in tracks if track.frame_id.lstrip("/") not in above]
    for track in tracks:
        if track not in kept:
            index.warnings.append(f"{track.topic} is left out: its frame {track.frame_id} is no sensor's")
    return kept


def _one_per_frame(index: BagIndex, tracks: list[Track], option: str) -> list[Track]:
    """One topic of each sensor: Livox messages before clouds, compressed before raw images, then by name."""
    preferred = sorted(tracks, key=lambda t: (t.ros_type not in _PREFERRED, t.topic))
    chosen: dict[str, Track] = {}
    for track in preferred:
        used = chosen.setdefault(track.frame_id, track)
        if used is not track:
            index.warnings.append(
                f"{track.topic} is left out: {used.topic} is of the same frame {track.frame_id}; "
                f"choose with --set input.{option}"
            )
    return sorted(chosen.values(), key=lambda track: track.topic)


_PREFERRED = {kind for kind, message in CLOUDS.items() if message is LivoxCustomMsg} | {
    "sensor_msgs/msg/CompressedImage"
}


def _mounting(index: BagIndex, target: str, source: str, stamp_ns: I64) -> tuple[F64, Bool]:
    if target.lstrip("/") == source.lstrip("/"):
        return np.broadcast_to(np.eye(4), (len(stamp_ns), 4, 4)), np.ones(len(stamp_ns), np.bool_)
    return index.tree.lookup(target, source, stamp_ns)


def _leave_out(index: BagIndex, count: int, reason: str, track: Track, frame: str) -> None:
    add_counts(index.lost, {reason: count})
    index.warnings.append(
        f"{count} messages of {track.topic} are left out: tf does not join {track.frame_id} and {frame} there"
    )


def _name(track: Track, tracks: list[Track]) -> str:
    """The sensor's frame, or its topic where that names several."""
    shared = sum(other.frame_id == track.frame_id for other in tracks) > 1
    return (
        track.topic.strip("/").replace("/", "_")
        if shared or not track.frame_id
        else track.frame_id.strip("/")
    )


def _format(index: BagIndex, track: Track) -> CloudFormat:
    """What the fields of a topic mean, settled on its first cloud that holds points."""
    for reference in track.references[:_TRIALS]:
        try:
            message = CLOUDS[track.ros_type].read(reference.connection.reader(reference.data()))
            if len(point_records(message)):
                return settle_format(message)
        except CdrError:
            continue
    index.warnings.append(f"the first {_TRIALS} clouds of {track.topic} are empty; point times are not used")
    return CloudFormat()


def _model(index: BagIndex, track: Track) -> CameraModel | None:
    info = next((index.infos[t] for t in info_topics(track.topic) if t in index.infos), None)
    if info is None:
        info = next((i for i in index.infos.values() if i.header.frame_id == track.frame_id), None)
    if info is None:
        _leave_camera(index, track, "images_uncalibrated", "there is no CameraInfo for it")
        return None
    rectified = "rect" in track.topic.removesuffix("/compressed").rpartition("/")[2]
    model = camera_model(info, rectified)
    if model is None:
        why = "its CameraInfo is no pinhole with plumb_bob"
        _leave_camera(index, track, "images_uncalibrated", why)
        return None
    fault = _image_fault(track, model)
    if fault is not None:
        _leave_camera(index, track, *fault)
    return model if fault is None else None


def _leave_camera(index: BagIndex, track: Track, reason: str, why: str) -> None:
    add_counts(index.lost, {reason: len(track.references)})
    index.warnings.append(f"{track.topic} is left out: {why}")


def _image_fault(track: Track, model: CameraModel) -> tuple[str, str] | None:
    """Reason and sentence why none of some images from first to last is of use with the model, None if one is."""
    some = np.unique(np.linspace(0, len(track.references) - 1, _TRIALS).astype(int)).tolist()
    fault = None
    for k in some:
        of_this = _fault_of(track, k, model)
        if of_this is None:
            return None
        fault = fault or of_this
    return fault


def _fault_of(track: Track, k: int, model: CameraModel) -> tuple[str, str] | None:
    try:
        encoded = _image(track, k)
        pixels = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_UNCHANGED) if encoded else None
    except CdrError as error:
        return "images_undecodable", f"its images cannot be decoded ({error})"
    except cv2.error:
        pixels = None
    if pixels is None:
        return "images_undecodable", "its images cannot be decoded"
    if pixels.shape[:2] != (model.height, model.width):
        size = f"{pixels.shape[1]} x {pixels.shape[0]}"
        says = f"its images are {size} where CameraInfo says {model.width} x {model.height}"
        return "images_uncalibrated", says
    return None


def _image(track: Track, k: int) -> bytes:
    reference = track.references[k]
    return encoded_image(IMAGES[track.ros_type].read(reference.connection.reader(reference.data())))


def _imu_mounting(index: BagIndex, topic: str, frame: str, lidar_frame: str) -> F64:
    """T_lidar_imu (4, 4); identity with a warning where tf does not say."""
    T, known = _mounting(index, lidar_frame, frame, np.zeros(1, np.int64))
    if not known.all():
        index.warnings.append(
            f"tf does not say how the IMU {topic} is mounted; taken to have the LiDAR's axes"
        )
    mounting: F64 = T[0]
    return mounting
