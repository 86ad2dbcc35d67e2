"""COLMAP model of the kept images and points, as 3D Gaussian splatting takes it.

``out/images/`` and ``out/sparse/0/`` with ``cameras.txt``, ``images.txt`` and ``points3D.txt``. Lenses are undone,
since trainers want pinhole images: every camera is a ``PINHOLE`` that sees only what its photograph shows. In COLMAP
the centre of the first pixel lies at (0.5, 0.5), and quaternions begin with w.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TextIO

import cv2
import numpy as np

from artemis_edge.colouring import kept_photographs, sees
from artemis_edge.errors import InputError, RunError
from artemis_edge.evaluate.photos import Photo, count_photos
from artemis_edge.export.places import check_new_folder
from artemis_edge.frames import F32, F64, I64, U8, CameraModel
from artemis_edge.kept_images import INDEX
from artemis_edge.kept_points import KeptPoints
from artemis_edge.progress import Report, silent
from artemis_edge.splats import blank, lens_of, splat
from artemis_edge.trajectory import inverse, quaternion_from_matrix

#: Points at most: as many as a trainer starts from; it makes more where they are needed.
MOST_POINTS = 200_000
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 97]
_UNKNOWN_ERROR = -1.0  # of a point, in pixels: COLMAP's own mark for one that was not measured
_ROWS_AT_ONCE = 50_000


@dataclass(frozen=True, slots=True)
class _Cloud:
    """Points float32 (n, 3) and colours uint8 (n, 3); ``chosen`` int64 (k,) are those in the model."""

    points: F32
    colours: U8
    chosen: I64


@dataclass(frozen=True, slots=True)
class _Observations:
    """Which of the chosen points int64 (o,) an image sees, and where, float64 (o, 2) in our pixels."""

    point: I64
    place: F64


def write_colmap(folder: Path, kept: KeptPoints, map_dir: Path, report: Report = silent) -> None:
    """Write the model of a map's folder ``map_dir`` into a new ``folder``.

    Raises InputError when the folder holds something or the map kept no images, RunError when a file cannot be
    written; nothing half-written is left.
    """
    index = map_dir / INDEX
    if not index.is_file():
        raise InputError(
            f"{map_dir} keeps no images; map a recording with a camera and with keep.images above 0"
        )
    check_new_folder("--out", folder, (map_dir,))
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".colmap-", dir=folder.parent) as scratch:
            _write_model(Path(scratch) / "model", _cloud(kept), index, report)
            if folder.exists():
                folder.rmdir()
            shutil.move(Path(scratch) / "model", folder)
    except OSError as error:
        raise RunError(
            f"cannot write {folder}: {error.strerror or error}; free space or choose another place"
        ) from None


def _cloud(kept: KeptPoints) -> _Cloud:
    points, colours = [], []
    for rows in kept.chunks():
        seen = rows["seen"] > 0
        points.append(rows["position"][seen])
        colours.append(rows["colour"][seen])
    count = sum(len(part) for part in points)
    if count == 0:
        raise InputError("no image sees any of the map's points; check the calibration of the camera")
    chosen = np.arange(0, count, -(-count // MOST_POINTS))
    return _Cloud(np.concatenate(points), np.concatenate(colours), chosen)


def _write_model(folder: Path, cloud: _Cloud, index: Path, report: Report) -> None:
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    (folder / "images").mkdir()
    cameras: dict[CameraModel, int] = {}
    tracks: list[tuple[I64, int]] = []
    total = count_photos(index)
    with (sparse / "images.txt").open("w") as file:
        file.write(
            "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then X Y POINT3D_ID of each point it sees\n"
        )
        for done, photo in enumerate(kept_photographs(index)):
            straight = undistorted(photo)
            number = cameras.setdefault(straight.camera, len(cameras) + 1)
            found = _observe(cloud, straight)
            _write_image(file, done + 1, number, straight, found)
            _save(folder / "images" / straight.file, straight.image)
            tracks.append((found.point, done + 1))
            report(done + 1, total, straight.file)
    if not tracks:
        raise InputError(f"none of the photographs that {index} names can be read; map the recording again")
    _write_cameras(sparse / "cameras.txt", cameras)
    with (sparse / "points3D.txt").open("w") as file:
        _write_points(file, cloud, tracks)


def undistorted(photo: Photo) -> Photo:
    """The photograph as a pinhole of the same size that sees only what it shows, and its bare file name."""
    name = Path(photo.file).with_suffix(".jpg").name
    camera = photo.camera
    if not any(camera.distortion):
        return replace(photo, file=name)
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    size, distortion = (camera.width, camera.height), np.array(camera.distortion)
    new, _ = cv2.getOptimalNewCameraMatrix(K, distortion, size, 0.0)
    maps = cv2.initUndistortRectifyMap(K, distortion, np.eye(3), new, size, cv2.CV_32FC1)
    image = np.asarray(cv2.remap(photo.image, *maps, cv2.INTER_CUBIC), np.uint8)
    pinhole = CameraModel(*size, float(new[0, 0]), float(new[1, 1]), float(new[0, 2]), float(new[1, 2]))
    return Photo(name, image, pinhole, photo.T_world_cam)


def _observe(cloud: _Cloud, photo: Photo) -> _Observations:
    T_cam_world, lens = inverse(photo.T_world_cam), lens_of(photo.camera)
    nearest, number = blank(photo.camera)
    splat(cloud.points, T_cam_world, lens, 0, nearest, number)
    place = sees(cloud.points[cloud.chosen], T_cam_world, lens, nearest)
    point = np.flatnonzero(np.isfinite(place[:, 0]))
    return _Observations(point, place[point])


def _save(path: Path, image: U8) -> None:
    path.write_bytes(cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), _JPEG)[1].tobytes())


def _write_cameras(path: Path, cameras: dict[CameraModel, int]) -> None:
    lines = ["# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY\n"]
    for camera, number in cameras.items():
        lines.append(
            f"{number} PINHOLE {camera.width} {camera.height} {camera.fx:.6f} {camera.fy:.6f} "
            f"{camera.cx + 0.5:.6f} {camera.cy + 0.5:.6f}\n"
        )
    path.write_text("".join(lines))


def _write_image(file: TextIO, number: int, camera: int, photo: Photo, found: _Observations) -> None:
    T = inverse(photo.T_world_cam)
    x, y, z, w = quaternion_from_matrix(T).tolist()
    pose = " ".join(f"{value:.9f}" for value in (w, x, y, z, *T[:3, 3].tolist()))
    file.write(f"{number} {pose} {camera} {photo.file}\n")
    rows = np.concatenate([found.place + 0.5, found.point[:, None] + 1], axis=1)
    for start in range(0, len(rows), _ROWS_AT_ONCE):
        part = rows[start : start + _ROWS_AT_ONCE]
        file.write("%.2f %.2f %d " * len(part) % tuple(part.reshape(-1).tolist()))
    file.write("\n")


def _write_points(file: TextIO, cloud: _Cloud, tracks: list[tuple[I64, int]]) -> None:
    file.write("# POINT3D_ID X Y Z R G B ERROR, then IMAGE_ID POINT2D_IDX of each image that sees it\n")
    for k, track in enumerate(_tracks(tracks, len(cloud.chosen))):
        row = cloud.chosen[k]
        x, y, z = cloud.points[row].tolist()
        r, g, b = cloud.colours[row].tolist()
        ends = "%d %d " * (len(track) // 2) % tuple(track)
        file.write(f"{k + 1} {x:.4f} {y:.4f} {z:.4f} {r} {g} {b} {_UNKNOWN_ERROR:g} {ends}\n")


def _tracks(seen: list[tuple[I64, int]], points: int) -> Iterator[list[int]]:
    """For every point the images that see it: image number and index in its list, one after the other."""
    point = np.concatenate([part for part, _ in seen])
    image = np.concatenate([np.full(len(part), number, np.int32) for part, number in seen])
    place = np.concatenate([np.arange(len(part), dtype=np.int32) for part, _ in seen])
    order = np.argsort(point, kind="stable")
    ends = np.stack([image[order], place[order]], axis=1)
    start = np.searchsorted(point[order], np.arange(points + 1))
    for k in range(points):
        yield ends[start[k] : start[k + 1]].reshape(-1).tolist()
