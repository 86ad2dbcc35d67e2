"""Calibrations made with other tools: kalibr's camera chain and FAST-LIVO2's two YAML files.

The directions differ and are spelled out here: kalibr's ``T_cam_imu`` maps IMU to camera (as ours would),
``T_cn_cnm1`` the camera before to this one, and its time shift holds t_imu = t_cam + shift; FAST-LIVO2's
``extrinsic_R/T`` maps LiDAR to IMU and ``Rcl/Pcl`` LiDAR to camera; it adds ``img_time_offset`` to images and takes
``imu_time_offset`` off the IMU's stamps.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from artemis_edge.devices.calibration import Calibration, CameraCalibration, require_sound, to_matrix
from artemis_edge.errors import InputError
from artemis_edge.frames import F64

_Tree = dict[str, Any]


def read_yaml(path: Path) -> _Tree:
    """A YAML file as plain values; needs the extra ``import``."""
    try:
        from ruamel.yaml import YAML
        from ruamel.yaml.error import YAMLError
    except ImportError:
        raise InputError("YAML files need the extra: pip install 'artemis-edge[import]'") from None
    try:
        text = path.read_text()
        tree = YAML(typ="safe", pure=True).load(text.removeprefix("%YAML:1.0"))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except (YAMLError, UnicodeDecodeError, ValueError) as error:
        raise InputError(f"{path} is not valid YAML: {str(error).splitlines()[0]}") from None
    if not isinstance(tree, dict) or not all(isinstance(name, str) for name in tree):
        raise InputError(f"{path} holds no calibration; give a camera chain or a FAST-LIVO2 file")
    return tree


def from_kalibr(path: Path, base: Calibration) -> Calibration:
    """Cameras of a kalibr camchain; mountings need ``base.T_imu_lidar``, the rest of ``base`` is kept."""
    tree = read_yaml(path)
    names = sorted((k for k in tree if k.startswith("cam") and k[3:].isdecimal()), key=lambda k: int(k[3:]))
    if not names:
        raise InputError(f"{path} has no cam0; give the camchain-imucam file that kalibr wrote")
    T_imu_lidar = np.array(base.T_imu_lidar, np.float64)
    cameras, T_cam_imu = dict(base.cameras), None
    for name in names:
        entry = _Entry(tree[name], f"{path}: {name}")
        T_cam_imu = _cam_imu(entry, T_cam_imu)
        fx, fy, cx, cy = _kalibr_lens(entry)
        width, height = (int(v) for v in entry.numbers("resolution", 2))
        shift = float(entry.numbers("timeshift_cam_imu", 1, default=0.0)[0])
        cameras[f"cam_{name[3:]}"] = CameraCalibration(
            width, height, fx, fy, cx, cy, to_matrix(T_cam_imu @ T_imu_lidar),
            _padded(entry.numbers("distortion_coeffs", 4)), shift + base.imu_time_offset_s,
        )  # fmt: skip
    found = msgspec.structs.replace(base, cameras=cameras)
    require_sound(found, str(path))
    return found


def from_fast_livo2(path: Path, lens: Path, name: str = "cam_0") -> Calibration:
    """The rig of FAST-LIVO2's ``avia.yaml`` and ``camera_pinhole.yaml``."""
    tree, optics = read_yaml(path), _Entry(read_yaml(lens), str(lens))
    mounts = _Entry(tree.get("extrin_calib"), f"{path}: extrin_calib")
    times = _Entry(tree.get("time_offset", {}), f"{path}: time_offset")
    if optics.tree.get("cam_model", "Pinhole") != "Pinhole":
        raise InputError(f"{lens}: cam_model is {optics.tree['cam_model']}; only Pinhole can be imported")
    fx, fy, cx, cy = (float(optics.numbers(f"cam_{key}", 1)[0]) for key in ("fx", "fy", "cx", "cy"))
    scale = float(optics.numbers("scale", 1, default=1.0)[0])
    width, height = (int(optics.numbers(f"cam_{key}", 1)[0]) for key in ("width", "height"))
    camera = CameraCalibration(
        round(width * scale), round(height * scale), fx * scale, fy * scale, cx * scale, cy * scale,
        to_matrix(_mount(mounts.numbers("Rcl", 9), mounts.numbers("Pcl", 3))),
        _padded([optics.numbers(f"cam_d{k}", 1, default=0.0)[0] for k in range(4)]),
        float(times.numbers("img_time_offset", 1, default=0.0)[0]),
    )  # fmt: skip
    found = Calibration(
        T_imu_lidar=to_matrix(_mount(mounts.numbers("extrinsic_R", 9), mounts.numbers("extrinsic_T", 3))),
        imu_time_offset_s=0.0 - float(times.numbers("imu_time_offset", 1, default=0.0)[0]),
        cameras={name: camera},
    )
    require_sound(found, str(path))
    return found


class _Entry:
    """A mapping of a YAML file whose numbers are looked up by name; ``where`` is for the sentence."""

    def __init__(self, tree: Any, where: str) -> None:
        if not isinstance(tree, dict):
            raise InputError(f"{where} is missing or no mapping; give the whole file")
        self.tree: _Tree = tree
        self.where = where

    def numbers(self, key: str, count: int, default: float | None = None) -> F64:
        """``count`` numbers (any nesting) of a field."""
        value: ArrayLike | None = self.tree.get(key, default)
        try:
            found = np.asarray(value, np.float64).reshape(-1)
        except (TypeError, ValueError):
            found = np.empty(0)
        if value is None or len(found) != count or not np.isfinite(found).all():
            raise InputError(f"{self.where}: {key} should be {count} numbers")
        return found


def _cam_imu(entry: _Entry, before: F64 | None) -> F64:
    if "T_cam_imu" in entry.tree:
        return entry.numbers("T_cam_imu", 16).reshape(4, 4)
    if before is None:
        raise InputError(
            f"{entry.where}: there is no T_cam_imu; calibrate the cameras against the IMU with kalibr first"
        )
    T: F64 = entry.numbers("T_cn_cnm1", 16).reshape(4, 4) @ before
    return T


def _kalibr_lens(entry: _Entry) -> tuple[float, float, float, float]:
    model, lens = entry.tree.get("camera_model"), entry.tree.get("distortion_model")
    if model != "pinhole" or lens != "radtan":
        raise InputError(f"{entry.where}: {model}-{lens} cannot be imported; calibrate as pinhole-radtan")
    fx, fy, cx, cy = (float(v) for v in entry.numbers("intrinsics", 4))
    return fx, fy, cx, cy


def _mount(R: F64, t: F64) -> F64:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.reshape(3, 3), t
    return T


def _padded(values: ArrayLike) -> tuple[float, float, float, float, float]:
    """k1, k2, p1, p2 with the k3 that neither tool has."""
    k1, k2, p1, p2 = (float(v) for v in np.asarray(values, np.float64))
    return k1, k2, p1, p2, 0.0
