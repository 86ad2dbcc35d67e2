"""True views of a virtual world, as a perfect camera would take them: colour, depth, class and instance.

``simulate --set truth_images=N`` writes N of them beside the walk into ``truth/views``; for any other pose:

    python -m artemis_edge.session.true_views SESSION/truth --pose "tx ty tz qx qy qz qw" --out FOLDER

PHOTOS.json there is that of ``evaluate texture``; each entry also names ``truth``, an .npz file with ``depth``
float32 (h, w) in metres along z (NaN where nothing), ``label`` uint8 and ``instance`` int32 (-1 where nothing).
"""

from __future__ import annotations

import argparse
import io
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from artemis_drivers.virtual.camera import VirtualCamera
from artemis_drivers.virtual.sensor import AutoExposure, Exposure, ideal
from artemis_drivers.virtual.true_view import TrueView, truth_images

from artemis_edge.errors import InputError, UserError
from artemis_edge.export.atomic import write_bytes
from artemis_edge.frames import F64
from artemis_edge.json_file import read_json
from artemis_edge.render import parse_pose
from artemis_edge.session.photos import INDEX
from artemis_edge.session.rig import FRAME_S, Rig, Settings, build_rig
from artemis_edge.trajectory import inverse

FOLDER = "views"
# Held-out views stand beside the walk, on whose path nothing is nearer than 0.3 m, and look elsewhere.
_ASIDE_M = np.array([0.15, 0.1, 0.1])
_TURNED_DEG = np.array([5.0, 15.0, 3.0])


@dataclass(frozen=True, slots=True)
class Wanted:
    """A view: ``T_session_cam`` (4, 4) and the time of the walk, which decides where moving things are."""

    T_session_cam: F64
    time_s: float


def true_view(rig: Rig, camera: VirtualCamera, wanted: Wanted) -> tuple[TrueView, Exposure]:
    """What ``camera`` would see, and the exposure that it would settle on, with which ``colour`` is made."""
    T_world_cam = inverse(rig.T_session_world()) @ wanted.T_session_cam
    scene = rig.window.at(float(T_world_cam[0, 3]))
    view = truth_images(scene, rig.world.sun, T_world_cam, camera, wanted.time_s)
    settled = AutoExposure(camera.spec.sensor).next(float(view.light[:, :, 1].mean()))
    colour = ideal(view.light, camera.spec.sensor, settled)
    return TrueView(colour, view.light, view.depth, view.label, view.instance), settled


def write_views(rig: Rig, frames: int, truth: Path) -> int:
    """The held-out views of a session; returns their number. Raises RunError when the disk refuses."""
    views = held_out(rig, frames)
    if views:
        write(rig, views, truth / FOLDER)
    return len(views)


def held_out(rig: Rig, frames: int) -> list[Wanted]:
    """Views evenly over the walk, at times between photographs, at places where none was taken."""
    count = rig.settings.truth_images
    rng = np.random.default_rng([rig.seed, 61])
    views = []
    for k in range(count):
        time = round((k + 0.5) / count * frames) * FRAME_S
        beside = np.eye(4)
        turn = np.radians(_TURNED_DEG * rng.uniform(-1, 1, 3))
        beside[:3, :3] = cv2.Rodrigues(turn)[0]
        beside[:3, 3] = _ASIDE_M * rng.uniform(-1, 1, 3)
        views.append(Wanted(rig.T_session_world() @ rig.camera_pose(time) @ beside, time))
    return views


def write(rig: Rig, views: Sequence[Wanted], folder: Path) -> None:
    """Write views and their index; raises RunError when the disk refuses."""
    folder.mkdir(parents=True, exist_ok=True)
    camera = rig.new_camera()
    entries = []
    for k, wanted in enumerate(views):
        view, exposure = true_view(rig, camera, wanted)
        _, png = cv2.imencode(".png", cv2.cvtColor(view.colour, cv2.COLOR_RGB2BGR))
        write_bytes(folder / f"{k:04d}.png", png.tobytes())
        arrays = io.BytesIO()
        np.savez_compressed(arrays, depth=view.depth, label=view.label, instance=view.instance)
        write_bytes(folder / f"{k:04d}.npz", arrays.getvalue())
        entries.append(_entry(rig, k, wanted, exposure))
    write_bytes(folder / INDEX, (json.dumps({"photos": entries}, indent=1) + "\n").encode())


def _entry(rig: Rig, k: int, wanted: Wanted, exposure: Exposure) -> dict[str, Any]:
    spec = rig.camera
    return {
        "file": f"{k:04d}.png",
        "truth": f"{k:04d}.npz",
        "fx": spec.fx,
        "fy": spec.fy,
        "cx": spec.cx,
        "cy": spec.cy,
        "distortion": list(spec.distortion),
        "T_cam_world": inverse(wanted.T_session_cam).tolist(),
        "time_s": wanted.time_s,
        "exposure_s": exposure.exposure_s,
        "gain": exposure.gain,
    }


def reopen(truth: Path) -> Rig:
    """The rig of a session, from its ``truth/world.json``; InputError when there is none that fits."""
    path = truth / "world.json"
    try:
        said = read_json(path)
        settings = msgspec.convert(said["settings"], Settings)
        return build_rig(said["world"], said["seed"], said["seconds"], said["lidar"], settings)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path} does not describe a virtual session ({error}); give the truth/ of one"
        ) from None


def main(arguments: Sequence[str] | None = None) -> int:
    """The module as a command of its own."""
    parser = argparse.ArgumentParser(prog="python -m artemis_edge.session.true_views")
    parser.add_argument("truth", type=Path, metavar="SESSION/truth")
    parser.add_argument("--pose", action="append", required=True, metavar='"tx ty tz qx qy qz qw"')
    parser.add_argument("--time", type=float, default=0.0, help="seconds of the walk (default: 0)")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    given = parser.parse_args(arguments)
    try:
        views = [Wanted(parse_pose(text), given.time) for text in given.pose]
        write(reopen(given.truth), views, given.out)
    except UserError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
