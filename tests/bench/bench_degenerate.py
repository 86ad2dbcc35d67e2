"""Frames flagged as degenerate against the true normals of a virtual world.

    python tests/bench/bench_degenerate.py SESSION...

A frame counts as degenerate when the smallest eigenvalue of the mean of n n' over the true normals of its points is
below 0.01. The world of each session is built again and scanned as it was; what moves is left out.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import msgspec
import numpy as np

from artemis_edge.config import OdometryConfig
from artemis_edge.datasets import open_input
from artemis_edge.frames import F64
from artemis_edge.odometry.choice import odometry_for
from artemis_edge.session.recording import _made
from artemis_edge.session.rig import FRAME_S, Settings, build_rig

TRULY_DEGENERATE = 0.01


def true_shares(session: Path) -> F64:
    """Smallest eigenvalue (n,) of the mean of n n' of every frame."""
    world = json.loads((session / "truth" / "world.json").read_text())
    settings = msgspec.convert({**world["settings"], "camera": False}, Settings)
    rig = build_rig(world["world"], world["seed"], world["seconds"], world["lidar"], settings)
    shares, scene = [], None
    for made in _made(rig, round(world["seconds"] / FRAME_S), 2):
        frame = made.frame.result()
        if made.scene is not scene:
            scene = made.scene
            _, normals = scene.mesh.areas_and_normals()
        n = normals[frame.triangle[frame.triangle < len(normals)]]
        shares.append(np.linalg.eigvalsh(n.T @ n / max(len(n), 1))[0])
    return np.array(shares)


def main() -> None:
    parser = argparse.ArgumentParser(description="degenerate frames against true normals")
    parser.add_argument("sessions", type=Path, nargs="+")
    hit = degenerate = false = good = 0
    for session in parser.parse_args().sessions:
        truth = true_shares(session) < TRULY_DEGENERATE
        source = open_input(session)
        odometry = odometry_for(OdometryConfig(), source.frames)
        flagged = np.array([odometry.track(frame).degenerate for frame in source.frames()])
        here = (flagged & truth).sum(), truth.sum(), (flagged & ~truth).sum(), (~truth).sum()
        print(
            f"{session.name}: flagged {here[0]} of {here[1]} degenerate, {here[2]} of {here[3]} good frames"
        )
        hit, degenerate, false, good = (
            a + int(b) for a, b in zip((hit, degenerate, false, good), here, strict=True)
        )
    print(f"all: {hit} of {degenerate} degenerate, {false} of {good} good frames")


if __name__ == "__main__":
    main()
