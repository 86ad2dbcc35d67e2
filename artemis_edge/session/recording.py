"""Records what the virtual rig measures: LiDAR scans and photographs made ahead, written in order.

One thread scans and one photographs, each in order of time (a camera's exposure depends on the frames before),
while a third writes; a scene never changes and every scan has its own random numbers, so that the threads do not
show in the result.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from artemis_drivers.virtual.camera import Photo, VirtualCamera
from artemis_drivers.virtual.imu import ImuRecord
from artemis_drivers.virtual.lidar import Frame, scan
from artemis_drivers.virtual.scene import Scene

from artemis_edge.frames import F64
from artemis_edge.session.rig import (
    FRAME_NS,
    FRAME_S,
    START_NS,
    T_IMU_LIDAR,
    T_LIDAR_CAM,
    Rig,
    camera_model,
    texts,
)
from artemis_edge.session.writer import SessionWriter

_HALF_NS = 0.5e-9  # half a nanosecond: sums of times are not exact
_AHEAD = 4  # frames being made at most: bounds memory
_RECEIVED_NS = 20_000_000  # exposure, readout and transfer of a photograph

#: Called with (frames done, frames in all).
Progress = Callable[[int, int], None]
#: Called with every frame, the scene it was made in and its number.
Watch = Callable[[Frame, Scene, int], None]


@dataclass(slots=True)
class Counts:
    """What was written; ``beams`` is the number emitted."""

    points: int = 0
    beams: int = 0
    images: int = 0
    imu: int = 0


@dataclass(frozen=True, slots=True)
class _Made:
    """One window in the making."""

    scene: Scene
    frame: Future[Frame]
    photo: Future[Photo] | None


def record(
    rig: Rig, frames: int, path: Path, watch: Watch, progress: Progress | None, ahead: int = _AHEAD
) -> Counts:
    """Write the session file; raises RunError when the disk refuses."""
    counts = Counts()
    with SessionWriter(path, metadata={"simulation": _description(rig)}) as writer:
        writer.write_tf_static(START_NS, "lidar", "cam", T_LIDAR_CAM)
        writer.write_tf_static(START_NS, "imu", "lidar", T_IMU_LIDAR)
        for k, made in enumerate(_made(rig, frames, ahead)):
            frame = made.frame.result()
            watch(frame, made.scene, k)
            _write_frame(writer, rig, k, frame, made.photo, counts)
            if progress is not None:
                progress(k + 1, frames)
    return counts


def _made(rig: Rig, frames: int, ahead: int) -> Iterator[_Made]:
    """The windows in order, ``ahead`` of them being made while one is used."""
    camera = rig.new_camera() if rig.settings.camera else None
    waiting: deque[_Made] = deque()
    with ThreadPoolExecutor(1) as scanner, ThreadPoolExecutor(1) as photographer:
        try:
            for k in range(frames):
                scene = rig.window.at(rig.x_at(k * FRAME_S))
                photo = _start_photo(rig, camera, scene, k, photographer)
                waiting.append(_Made(scene, scanner.submit(_scan, rig, scene, k), photo))
                if len(waiting) == ahead:
                    yield waiting.popleft()
            while waiting:
                yield waiting.popleft()
        finally:  # whoever uses the windows may have failed
            scanner.shutdown(cancel_futures=True)
            photographer.shutdown(cancel_futures=True)


def _start_photo(
    rig: Rig, camera: VirtualCamera | None, scene: Scene, k: int, pool: ThreadPoolExecutor
) -> Future[Photo] | None:
    """The photograph is taken in the middle of the LiDAR's window."""
    if camera is None or k % rig.settings.camera_every:
        return None
    time_s = k * FRAME_S + FRAME_S / 2
    return pool.submit(camera.photograph, scene, rig.world.sun, rig.camera_pose, time_s, k)


def _scan(rig: Rig, scene: Scene, k: int) -> Frame:
    rng = np.random.default_rng([rig.seed, 41, k])
    beams = rig.sensor.beams(k, rig.settings.density)
    return scan(scene, rig.motion, T_IMU_LIDAR, beams, k * FRAME_S, rig.sensor.spec, rng)


def _write_frame(
    writer: SessionWriter, rig: Rig, k: int, frame: Frame, photo: Future[Photo] | None, counts: Counts
) -> None:
    """Messages of one window in the order in which a host would receive them."""
    stamp = START_NS + k * FRAME_NS
    middle, end = stamp + FRAME_NS // 2, stamp + FRAME_NS
    received = middle + _RECEIVED_NS
    for at, gyro, accel in _imu_samples(rig.imu, k):
        if photo is not None and at > received:
            _write_photo(writer, rig, middle, photo.result(), counts)
            photo = None
        writer.write_imu(at, gyro, accel)
        counts.imu += 1
    if photo is not None:
        _write_photo(writer, rig, middle, photo.result(), counts)
    writer.write_points(
        stamp,
        frame.points,
        intensity=frame.intensity,
        tag=frame.tag,
        line=frame.line,
        offset_ns=frame.offset_ns,
        receive_ns=end,
    )
    counts.points += len(frame.points)
    counts.beams += frame.emitted


def _imu_samples(imu: ImuRecord | None, k: int) -> Iterator[tuple[int, F64, F64]]:
    """Stamp, gyro and accel of the samples of window k; the last window has the one at its end as well."""
    if imu is None:
        return
    first, stop = np.searchsorted(imu.time_s, np.array([k, k + 1]) * FRAME_S - _HALF_NS)
    stop += stop + 1 == len(imu.time_s)
    for n in range(first, stop):
        yield START_NS + round(float(imu.time_s[n]) * 1e9), imu.gyro[n], imu.accel[n]


def _write_photo(writer: SessionWriter, rig: Rig, stamp: int, photo: Photo, counts: Counts) -> None:
    received = stamp + _RECEIVED_NS
    model = camera_model(rig.camera)
    if photo.encoding == "jpeg":
        writer.write_image(stamp, photo.data, receive_ns=received)
    else:
        writer.write_raw_image(stamp, photo.data, model, encoding=photo.encoding, receive_ns=received)
    writer.write_camera_info(stamp, model, receive_ns=received)
    writer.write_exposure(stamp, photo.exposure_s, photo.gain, receive_ns=received)
    counts.images += 1


def _description(rig: Rig) -> dict[str, str]:
    return {"world": rig.world.name, "seed": str(rig.seed), "lidar": rig.sensor_name, **texts(rig.settings)}
