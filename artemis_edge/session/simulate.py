"""``artemis-edge simulate``: a walk through a virtual world, written as a session with its ground truth.

The session's world frame is the first LiDAR frame, levelled; a walk that is not driven by a recording begins
exactly level, so that the frame is the same for odometry with and without an IMU. Ground truth lies in ``truth/``
beside the recording, never in it.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from artemis_drivers.virtual.catalogue import worlds
from artemis_drivers.virtual.lidars import LIDARS
from artemis_drivers.virtual.motion import Motion

from artemis_edge.errors import InputError
from artemis_edge.session.recording import Progress, record
from artemis_edge.session.rig import FRAME_NS, FRAME_S, build_rig, read_settings
from artemis_edge.session.true_views import write_views
from artemis_edge.session.truth_files import Witness, write_truth
from artemis_edge.session.writer import SessionWriter

WORLDS, LIDAR_NAMES = tuple(worlds()), tuple(LIDARS)
_FILE = "session.mcap"
_LONG_WALK_S, _LONGEST_S = 300.0, 86_400.0


@dataclass(frozen=True, slots=True)
class SimulationSummary:
    """What was written, and what was lost: beams that met nothing or too little light are no points.

    ``notes`` are sentences for the user about the world.
    """

    session: Path
    truth: Path
    frames: int
    points: int
    beams: int
    images: int
    imu_samples: int
    length_m: float
    triangles: int
    reference_points: int
    moving_points: int
    views: int
    notes: tuple[str, ...]


def simulate(
    world_name: str,
    seed: int,
    seconds: float,
    lidar: str,
    out: Path,
    settings: dict[str, str] | None = None,
    progress: Progress | None = None,
) -> SimulationSummary:
    """Write the session ``out`` (a directory: session.mcap and truth/) of a walk of ``seconds``.

    ``world_name`` is one of WORLDS or a .glb, .gltf or .obj file, ``lidar`` one of LIDAR_NAMES. Raises
    InputError for unknown names, settings or impossible lengths, RunError when the disk refuses.
    """
    if not FRAME_S <= seconds <= _LONGEST_S:
        raise InputError(f"--seconds {seconds:g}: give {FRAME_S:g} (one frame) to {_LONGEST_S:,.0f} (a day)")
    frames = round(seconds * 1e9 / FRAME_NS)
    rig = build_rig(world_name, seed, frames * FRAME_S, lidar, read_settings(settings or {}))
    truth = out / "truth"
    if (out / _FILE).exists() and not truth.exists():
        raise InputError(f"{out} holds a recording that is no simulation; choose another --out")
    truth.mkdir(parents=True, exist_ok=True)
    short = frames * FRAME_S <= _LONG_WALK_S
    s = rig.settings
    with ExitStack() as stack:
        points = short if s.point_truth is None else s.point_truth
        writer = stack.enter_context(SessionWriter(truth / "points.mcap")) if points else None
        witness = Witness(short if s.reference is None else s.reference, writer)
        counts = record(rig, frames, out / _FILE, witness.watch, progress)
    written = write_truth(rig, frames, truth, witness)
    return SimulationSummary(
        session=out,
        truth=truth,
        frames=frames,
        points=counts.points,
        beams=counts.beams,
        images=counts.images,
        imu_samples=counts.imu,
        length_m=_travelled(rig.motion, frames),
        triangles=written.triangles,
        reference_points=written.reference_points,
        moving_points=written.moving_points,
        views=write_views(rig, frames, truth),
        notes=rig.world.notes,
    )


def _travelled(motion: Motion, frames: int) -> float:
    position = motion.position(np.arange(frames + 1) * FRAME_S)
    return float(np.linalg.norm(np.diff(position, axis=0), axis=1).sum())
