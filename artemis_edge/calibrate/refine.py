"""Calibration from a recording alone: the IMU by the odometry's turns, every camera by what it sees."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from artemis_edge.calibrate.camera import CameraFit, CameraSolver, Score
from artemis_edge.calibrate.inertial import ImuFit, attitude_rms, fit_imu
from artemis_edge.calibrate.material import Material, collect
from artemis_edge.calibrate.mounts import CalibratedSource, CameraMount, ImuMount, Mounts, T_lidar_imu
from artemis_edge.devices.calibration import Calibration, CameraCalibration, to_matrix
from artemis_edge.errors import InputError
from artemis_edge.frames import F64, FrameSource, Odometry
from artemis_edge.odometry import se3
from artemis_edge.trajectory import inverse

# The odometry is better with a better IMU, and the IMU with better odometry. Of each round, how far the IMU may be
# turned: an odometry that trusts a gyroscope too much repeats its mount, and every round finds but a part of the error
_UNSURE_RAD = (0.035, 0.01, 0.01, 0.01)
_SETTLED_RAD, _SETTLED_S = 3e-4, 1e-4
_LEAST_FRAMES = 10

#: Makes the odometry of a source whose IMU may be turned by so many radian (one sigma).
MakeOdometry = Callable[[FrameSource, float], Odometry]
Report = Callable[[int, int], None]


@dataclass(slots=True)
class Refined:
    """``mounts`` are the best known; ``changed`` says whether anything is better than before.

    ``imu_fit`` and ``camera_fits`` are None where the recording does not tell; ``imu_rms`` before and after, rad.
    """

    mounts: Mounts
    material: Material
    imu_fit: ImuFit | None = None
    imu_rms: tuple[float, float] | None = None
    imu_better: bool = False
    camera_fits: dict[str, CameraFit | None] = field(default_factory=dict)

    @property
    def changed(self) -> bool:
        """Whether any sensor's mount is better than the present one."""
        return self.imu_better or any(better(fit) for fit in self.camera_fits.values())


def better(fit: CameraFit | None) -> bool:
    """Whether views that were not used speak for the refined mount."""
    return fit is not None and fit.after.total < fit.before.total


def refine(source: FrameSource, make: MakeOdometry, report: Report) -> Refined:
    """Refine all mounts of a source; InputError if it is too short."""
    if len(source) < _LEAST_FRAMES:
        raise InputError(
            f"{source.name} has {len(source)} frames; calibration needs at least {_LEAST_FRAMES}"
        )
    imu = ImuMount()
    fit: ImuFit | None = None
    for unsure_rad in _UNSURE_RAD:
        seen = CalibratedSource(source, Mounts(imu=imu))
        material = collect(seen, make(seen, unsure_rad), False, report)
        fit = None if material.stations else fit_imu(material.trajectory, material.imu)
        if fit is None:
            break
        imu = imu.then(fit.rotation, fit.time_offset_s)
        if np.linalg.norm(fit.rotation) < _SETTLED_RAD and abs(fit.time_offset_s) < _SETTLED_S:
            break
    seen = CalibratedSource(source, Mounts(imu=imu))
    material = collect(seen, make(seen, 0.0), True, report)
    refined = Refined(Mounts(imu=imu), material, fit)
    if fit is not None:
        _judge_imu(refined, imu, fit)
    for name, camera in sorted(material.cameras.items()):
        start = CameraMount(camera.T_cam_lidar)
        found = CameraSolver(material, camera, start).solve()
        refined.camera_fits[name] = found
        if found is not None and better(found):
            refined.mounts.cameras[name] = found.mount
    return refined


def _judge_imu(refined: Refined, imu: ImuMount, fit: ImuFit) -> None:
    """Keep the IMU's mount only if the attitudes fit better with it."""
    after = attitude_rms(refined.material.trajectory, refined.material.imu)
    back = ImuMount(imu.R.T, -imu.time_offset_s)
    before = attitude_rms(refined.material.trajectory, back.corrected(refined.material.imu))
    refined.imu_rms = before, after
    refined.imu_better = after < before
    mount = ImuMount(imu.R, imu.time_offset_s, fit.position) if refined.imu_better else ImuMount()
    refined.mounts = Mounts(refined.mounts.cameras, mount)


def to_calibration(refined: Refined, source: FrameSource, present: Calibration | None) -> Calibration:
    """The rig's calibration file; what was not refined is as the recording, or ``present``, has it."""
    cameras = dict(present.cameras) if present is not None else {}
    for name, camera in refined.material.cameras.items():
        mount = refined.mounts.cameras.get(name, CameraMount(camera.T_cam_lidar))
        before = cameras[name].time_offset_s if name in cameras else 0.0
        m = camera.model
        cameras[name] = CameraCalibration(
            m.width, m.height, m.fx, m.fy, m.cx, m.cy, to_matrix(mount.T_cam_lidar), m.distortion,
            before + mount.time_offset_s,
        )  # fmt: skip
    imu = refined.mounts.imu
    T = T_lidar_imu(source).copy() if present is None else inverse(np.array(present.T_imu_lidar))
    T[:3, :3] = imu.R @ T[:3, :3]
    if imu.origin is not None:
        T[:3, 3] = imu.origin
    offset = imu.time_offset_s + (present.imu_time_offset_s if present is not None else 0.0)
    return Calibration(
        serial=present.serial if present is not None else "",
        T_imu_lidar=to_matrix(inverse(T)),
        imu_time_offset_s=offset,
        cameras=cameras,
        residuals=_residuals(refined),
    )


def _residuals(refined: Refined) -> dict[str, float]:
    found = {} if refined.imu_rms is None else {"imu_attitude_rad": refined.imu_rms[refined.imu_better]}
    for name, fit in refined.camera_fits.items():
        if fit is not None:
            score = fit.after if better(fit) else fit.before
            found[f"{name}_photometric"] = score.photometric
            found[f"{name}_silhouettes_px2"] = score.silhouettes
    return found


def to_json(refined: Refined) -> dict[str, Any]:
    """Residuals before and after, and by how much every mount changed."""
    imu: dict[str, Any] | None = None
    if refined.imu_fit is not None and refined.imu_rms is not None:
        fit, mount = refined.imu_fit, refined.mounts.imu
        imu = {
            "better": refined.imu_better,
            "attitude_rms_rad": {"before": refined.imu_rms[0], "after": refined.imu_rms[1]},
            "turned_deg": float(np.degrees(Rotation.from_matrix(mount.R).magnitude())),
            "time_offset_ms": 1e3 * mount.time_offset_s,
            "sigma_deg": float(np.degrees(fit.sigma_rad)),
            "sigma_ms": 1e3 * fit.sigma_s,
            "position_m": None if fit.position is None else fit.position.tolist(),
            "position_sigma_m": fit.position_sigma_m.tolist(),
        }
    cameras = {
        name: None if fit is None else _camera_json(fit, refined.material.cameras[name].T_cam_lidar)
        for name, fit in refined.camera_fits.items()
    }
    return {"changed": refined.changed, "imu": imu, "cameras": cameras}


def _camera_json(fit: CameraFit, present: F64) -> dict[str, Any]:
    moved = se3.log(fit.mount.T_cam_lidar @ inverse(present))
    place, before = (-T[:3, :3].T @ T[:3, 3] for T in (fit.mount.T_cam_lidar, present))
    return {
        "better": better(fit),
        "turned_deg": float(np.degrees(np.linalg.norm(moved[3:]))),
        "moved_mm": float(1e3 * np.linalg.norm(place - before)),
        "time_offset_ms": 1e3 * fit.mount.time_offset_s,
        "sigma_deg": np.degrees(fit.sigma[3:6]).tolist(),
        "sigma_mm": (1e3 * fit.sigma[:3]).tolist(),
        "sigma_ms": 1e3 * float(fit.sigma[6]),
        "before": _score_json(fit.before),
        "after": _score_json(fit.after),
    }


def _score_json(score: Score) -> dict[str, float]:
    return {
        "photometric": score.photometric,
        "silhouettes_px2": score.silhouettes,
        "patches": score.patches,
        "silhouettes": score.rims,
    }


def to_text(refined: Refined) -> str:
    """The same in a few lines."""
    found = to_json(refined)
    lines = []
    lines.append(_imu_text(found["imu"]))
    lines += [_camera_text(name, camera) for name, camera in found["cameras"].items()]
    return "\n".join(lines)


def _imu_text(imu: dict[str, Any] | None) -> str:
    if imu is None:
        return "imu  not told: no IMU, or too few turns"
    rms = imu["attitude_rms_rad"]
    return (
        f"imu  {_verdict(imu['better'])}: turned {imu['turned_deg']:.3f} deg (+-{imu['sigma_deg']:.3f}), "
        f"offset {imu['time_offset_ms']:.2f} ms; "
        f"attitudes fit to {1e3 * rms['after']:.2f} mrad (was {1e3 * rms['before']:.2f})"
    )


def _camera_text(name: str, camera: dict[str, Any] | None) -> str:
    if camera is None:
        return f"{name}  not told: too few surfaces with contrast are seen"
    a, b = camera["after"], camera["before"]
    return (
        f"{name}  {_verdict(camera['better'])}: turned {camera['turned_deg']:.3f} deg, "
        f"moved {camera['moved_mm']:.1f} mm, offset {camera['time_offset_ms']:.2f} ms; "
        f"patches differ by {a['photometric']:.4f} (was {b['photometric']:.4f}), "
        f"silhouettes by {a['silhouettes_px2']:.2f} px2 (was {b['silhouettes_px2']:.2f})"
    )


def _verdict(improved: bool) -> str:
    return "better" if improved else "not better, kept as it was"
