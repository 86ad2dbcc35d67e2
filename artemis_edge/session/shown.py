"""Which points of a virtual world a walk's photographs show: what images cannot tell is not asked of a map of them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from artemis_drivers.virtual.camera import CameraSpec
from artemis_drivers.virtual.raycast import first_free_line

from artemis_edge.frames import F32, F64, I32
from artemis_edge.lens import fold_radius
from artemis_edge.session.rig import START_NS, Rig
from artemis_edge.trajectory import inverse

NEAR_M = 0.3  # nearer surfaces fill the image and are blurred
_SLACK_M = 0.01  # before a point, of its own surface


def views_of(rig: Rig, points: F32, stamps_ns: Iterable[int], reach_m: float) -> I32:
    """How many of the photographs taken at ``stamps_ns`` show each of ``points`` (n, 3, session frame), int32 (n,).

    A photograph shows what lies in its frame within ``reach_m`` along its axis, with a free line of sight. Panes of
    glass hide what beams find behind them: the camera sees the sky in them. What moves is taken to hide nothing.
    """
    out = np.zeros(len(points), np.int32)
    T = inverse(rig.T_session_world())
    world = points @ T[:3, :3].T + T[:3, 3]
    for stamp in stamps_ns:
        T_world_cam = rig.camera_pose((stamp - START_NS) * 1e-9)
        rows = np.flatnonzero(_in_frame(rig.camera, T_world_cam, world, reach_m))
        scene = rig.window.at(float(T_world_cam[0, 3]))
        eye = (T_world_cam[:3, 3] - scene.origin)[None]
        near = np.ascontiguousarray(world[rows] - scene.origin)
        eyes = np.zeros((len(rows), 1), np.int32)
        free = first_free_line(scene.bvh, near, eye, eyes, _SLACK_M)
        out[rows[free >= 0]] += 1
    return out


def _in_frame(spec: CameraSpec, T_world_cam: F64, world: F64, reach_m: float) -> np.ndarray:
    """bool (n,): what the lens projects into the image."""
    T = inverse(T_world_cam)
    local = world @ T[:3, :3].T + T[:3, 3]
    z = local[:, 2]
    inside = (z > NEAR_M) & (z < reach_m)
    x, y = (local[:, k] / np.where(inside, z, 1.0) for k in (0, 1))
    k1, k2, p1, p2, k3 = spec.distortion
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = spec.fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + spec.cx
    v = spec.fy * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + spec.cy
    inside &= (u > -0.5) & (v > -0.5) & (u < spec.width - 0.5) & (v < spec.height - 0.5)
    inside &= r2 < fold_radius(np.array(spec.distortion)) ** 2
    return np.asarray(inside)
