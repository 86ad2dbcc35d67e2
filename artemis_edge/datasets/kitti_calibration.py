"""Calibration files of KITTI: ``NAME: numbers`` a line.

A point X of the Velodyne falls on pixel ``P_rect_k R_rect_00 T_cam_velo X``. The last column of P_rect_k is
the offset of camera k from camera 0, seen through its intrinsics: taken apart here into CameraModel and
T_cam_lidar.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from artemis_edge.datasets.common import read_lines
from artemis_edge.errors import InputError
from artemis_edge.frames import F64, CameraModel


@dataclass(frozen=True, slots=True)
class Camera:
    """A rectified camera; ``name`` is the folder of its images."""

    name: str
    model: CameraModel
    T_cam_lidar: F64


def read_calibration(path: Path) -> dict[str, F64]:
    """Named rows of numbers; lines that hold text (``calib_time``) are passed over."""
    rows: dict[str, F64] = {}
    for line in read_lines(path):
        name, _, numbers = line.partition(":")
        try:
            rows[name.strip()] = np.array(numbers.split(), np.float64)
        except ValueError:
            continue
    return rows


def matrix(rows: dict[str, F64], name: str, shape: tuple[int, int], path: Path) -> F64:
    """The row ``name`` as a matrix; InputError if it is missing or of another length."""
    values = rows.get(name)
    if values is None or values.size != shape[0] * shape[1] or not np.isfinite(values).all():
        raise InputError(
            f"{path} must hold {shape[0] * shape[1]} numbers for '{name}'; copy the calibration again"
        )
    return values.reshape(shape)


def raw_cameras(drive: Path, day: Path, warnings: list[str]) -> list[Camera]:
    """Colour cameras of a raw drive that have images; none, with a warning, where calibration is missing."""
    names = [name for name in ("image_02", "image_03") if image_files(drive / name / "data")]
    cam_file, velo_file = day / "calib_cam_to_cam.txt", day / "calib_velo_to_cam.txt"
    if names and not (cam_file.is_file() and velo_file.is_file()):
        warnings.append(f"the images are not used: {cam_file.name} and {velo_file.name} are missing in {day}")
        return []
    if not names:
        return []
    cam, velo = read_calibration(cam_file), read_calibration(velo_file)
    T_rect_velo = np.eye(4)
    T_rect_velo[:3, :3] = matrix(cam, "R_rect_00", (3, 3), cam_file)
    T_rect_velo = T_rect_velo @ _rigid(velo, velo_file)
    return [
        _camera(
            name, matrix(cam, f"P_rect_{name[-2:]}", (3, 4), cam_file), T_rect_velo, drive / name / "data"
        )
        for name in names
    ]


def odometry_cameras(sequence: Path, warnings: list[str]) -> list[Camera]:
    """Colour cameras of an odometry sequence that have images; none, with a warning, without calibration."""
    path = sequence / "calib.txt"
    names = [name for name in ("image_2", "image_3") if image_files(sequence / name)]
    if not names:
        return []
    T_cam_velo = odometry_T_cam_velo(sequence)
    if T_cam_velo is None:
        warnings.append(f"the images are not used: {path} with Tr is missing")
        return []
    rows = read_calibration(path)
    return [_camera(n, matrix(rows, f"P{n[-1]}", (3, 4), path), T_cam_velo, sequence / n) for n in names]


def odometry_T_cam_velo(sequence: Path) -> F64 | None:
    """``T_cam0_velo`` (4, 4), the row ``Tr`` of ``calib.txt``; None without one."""
    path = sequence / "calib.txt"
    if not path.is_file():
        return None
    rows = read_calibration(path)
    if "Tr" not in rows:
        return None
    T = np.eye(4)
    T[:3] = matrix(rows, "Tr", (3, 4), path)
    return T


def raw_imu_mounting(day: Path) -> F64:
    """T_velo_imu (4, 4); identity (KITTI has their axes alike) without the file."""
    path = day / "calib_imu_to_velo.txt"
    if not path.is_file():
        return np.eye(4)
    return _rigid(read_calibration(path), path)


def _rigid(rows: dict[str, F64], path: Path) -> F64:
    T = np.eye(4)
    T[:3, :3] = matrix(rows, "R", (3, 3), path)
    T[:3, 3] = matrix(rows, "T", (3, 1), path)[:, 0]
    return T


def _camera(name: str, P: F64, T_rect_velo: F64, folder: Path) -> Camera:
    K = P[:, :3]
    T_cam_rect = np.eye(4)
    T_cam_rect[:3, 3] = np.linalg.solve(K, P[:, 3])
    width, height = _image_size(folder)
    model = CameraModel(width, height, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    return Camera(name, model, T_cam_rect @ T_rect_velo)


def image_files(folder: Path) -> list[Path]:
    """The images of a folder, by name."""
    return sorted([*folder.glob("*.png"), *folder.glob("*.jpg")])


def _image_size(folder: Path) -> tuple[int, int]:
    """Width and height of the first image that can be decoded: calibration files do not always state it."""
    for path in image_files(folder):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is not None:
            return int(image.shape[1]), int(image.shape[0])
    raise InputError(f"no image in {folder} can be decoded; copy the data set again or remove the folder")
