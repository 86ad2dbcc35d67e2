"""Calibration of a rig: where its sensors sit and how their clocks lie, one TOML file a rig.

Written by ``artemis-edge calibrate`` and by the importers, read by ``run``, ``reprocess`` and ``check``.
"""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import tomli_w
from msgspec import Meta, Struct

from artemis_edge.errors import InputError
from artemis_edge.export.atomic import write_bytes
from artemis_edge.frames import F64, CameraModel

Row = tuple[float, float, float, float]
Matrix = tuple[Row, Row, Row, Row]
_IDENTITY: Matrix = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))
_ROTATION_TOLERANCE = 1e-3  # printed matrices are rounded to 4 digits or more


class CameraCalibration(Struct, frozen=True, forbid_unknown_fields=True):
    """Lens (pinhole with k1, k2, p1, p2, k3, pixels), mounting (T_cam_lidar) and clock of one camera.

    ``time_offset_s`` is added to the stamps of images so that they are on the LiDAR's clock.
    """

    width: Annotated[int, Meta(ge=1, le=65535)]
    height: Annotated[int, Meta(ge=1, le=65535)]
    fx: Annotated[float, Meta(gt=0)]
    fy: Annotated[float, Meta(gt=0)]
    cx: float
    cy: float
    T_cam_lidar: Matrix
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    time_offset_s: Annotated[float, Meta(ge=-10.0, le=10.0)] = 0.0

    def model(self) -> CameraModel:
        """The lens as the mapping takes it."""
        return CameraModel(self.width, self.height, self.fx, self.fy, self.cx, self.cy, self.distortion)


class Calibration(Struct, frozen=True, forbid_unknown_fields=True):
    """All of a rig. ``imu_time_offset_s`` is added to the stamps of the IMU; residuals are said, not used."""

    serial: str = ""
    date: Annotated[str, Meta(description="When it was made, ISO 8601.")] = ""
    T_imu_lidar: Matrix = _IDENTITY
    imu_time_offset_s: Annotated[float, Meta(ge=-10.0, le=10.0)] = 0.0
    cameras: dict[str, CameraCalibration] = {}
    residuals: dict[str, float] = {}


def to_matrix(T: F64) -> Matrix:
    """A 4 x 4 array as the file keeps it."""
    rows = [tuple(float(v) for v in row) for row in np.asarray(T, np.float64)]
    return tuple(rows)  # type: ignore[return-value]


def read_calibration(path: Path) -> Calibration:
    """Read and check a calibration; InputError names the value that is wrong."""
    try:
        found = msgspec.convert(tomllib.loads(path.read_text()), Calibration, strict=False)
    except OSError as error:
        raise InputError(f"cannot read the calibration {path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not valid TOML: {error}") from None
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {error}; docs/calibration.md shows a whole file") from None
    require_sound(found, str(path))
    return found


def require_sound(calibration: Calibration, where: str) -> None:
    """InputError where a mounting is no rigid motion or a number is not finite."""
    mounts = {"T_imu_lidar": calibration.T_imu_lidar}
    mounts |= {f"cameras.{name}.T_cam_lidar": c.T_cam_lidar for name, c in calibration.cameras.items()}
    for name, mount in mounts.items():
        if not is_rigid(np.array(mount)):
            raise InputError(
                f"{where}: {name} is not a rotation with a translation; copy it with all its digits"
            )
    for name, camera in calibration.cameras.items():
        lens = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
        if not all(math.isfinite(value) for value in lens):
            raise InputError(f"{where}: the lens of cameras.{name} has a number that is not finite")


def is_rigid(T: F64) -> bool:
    """Whether a 4 x 4 matrix is a rotation with a translation, but for rounding."""
    if not np.isfinite(T).all() or not np.allclose(T[3], (0, 0, 0, 1), atol=_ROTATION_TOLERANCE):
        return False
    R = T[:3, :3]
    return bool(np.allclose(R @ R.T, np.eye(3), atol=_ROTATION_TOLERANCE) and np.linalg.det(R) > 0.0)


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write it; the file there before stays until the new one is complete."""
    require_sound(calibration, str(path))
    write_bytes(path, tomli_w.dumps(msgspec.to_builtins(calibration)).encode())
