"""The pose graph: the odometry's steps and the loops, brought into agreement (Dellaert and Kaess, GTSAM)."""

from __future__ import annotations

import numpy as np

from artemis_edge.frames import F64
from artemis_edge.loop.closure import Loop, require_extra
from artemis_edge.loop.keyframes import Keyframe
from artemis_edge.trajectory import inverse

_SIGMA_M, _SIGMA_RAD = 0.01, 0.002  # of a metre of odometry; they grow with the root of the way
_STEP_M = 0.3  # a turn on the spot counts as so much way
_FIRST_SIGMA = 1e-6
_ROBUST = 2.0  # deviations at which a loop loses weight: a wrong one must not bend the map


def optimise(keyframes: list[Keyframe], loops: list[Loop]) -> F64:
    """Corrected T_world_lidar (k, 4, 4) of the keyframes; the first stays where it is."""
    require_extra()
    import gtsam

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    poses = [gtsam.Pose3(k.T_world_lidar) for k in keyframes]
    first = gtsam.noiseModel.Isotropic.Sigma(6, _FIRST_SIGMA)
    graph.add(gtsam.PriorFactorPose3(0, poses[0], first))
    for k, pose in enumerate(poses):
        values.insert(k, pose)
        if k:
            step = inverse(keyframes[k - 1].T_world_lidar) @ keyframes[k].T_world_lidar
            root = np.sqrt(float(np.linalg.norm(step[:3, 3])) + _STEP_M)
            sigmas = np.array([_SIGMA_RAD] * 3 + [_SIGMA_M] * 3) * root
            noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
            graph.add(gtsam.BetweenFactorPose3(k - 1, k, gtsam.Pose3(step), noise))
    robust = gtsam.noiseModel.mEstimator.Cauchy.Create(_ROBUST)
    for loop in loops:
        certain = gtsam.noiseModel.Robust.Create(
            robust, gtsam.noiseModel.Gaussian.Information(0.5 * (loop.information + loop.information.T))
        )
        graph.add(gtsam.BetweenFactorPose3(loop.a, loop.b, gtsam.Pose3(loop.T_a_b), certain))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return np.array([found.atPose3(k).matrix() for k in range(len(keyframes))])
