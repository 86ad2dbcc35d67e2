"""``artemis-edge calibrate``: mounts and time offsets from a recording."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from artemis_edge.commands.common import DONE, FELL_SHORT, command, json_option, print_json


def add(commands: Any) -> None:
    """Declare ``calibrate``."""
    parser = command(
        commands,
        "calibrate",
        run_calibrate,
        "refine where camera and IMU sit, and their clocks, from a recording",
    )
    parser.add_argument("input", type=Path, metavar="INPUT", help="a session, a bag or a data set")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="CALIBRATION.toml", help="written if better"
    )
    parser.add_argument(
        "--from",
        type=Path,
        metavar="CALIBRATION.toml",
        dest="start",
        help="begin with this, not the recording's",
    )
    poses = parser.add_mutually_exclusive_group()
    poses.add_argument("--poses", type=Path, metavar="FILE.tum", help="poses of the LiDAR to rely on")
    poses.add_argument(
        "--no-poses", action="store_true", help="estimate the poses even where the input has some"
    )
    parser.add_argument("--overlay", type=Path, metavar="FILE.png", help="default: beside --out")
    json_option(parser)


def run_calibrate(given: argparse.Namespace) -> int:
    """``artemis-edge calibrate``: 1 if nothing is better than it was; then nothing is written but the overlay."""
    from artemis_edge.calibrate import refine
    from artemis_edge.calibrate.overlay import write_overlay
    from artemis_edge.calibrate.session import open_for_calibration
    from artemis_edge.devices.calibration import read_calibration, write_calibration
    from artemis_edge.export.places import check_file
    from artemis_edge.progress import progress, say

    overlay = given.overlay or given.out.with_suffix(".png")
    check_file("--out", given.out, (".toml",), (given.poses,))
    check_file("--overlay", overlay, (".png",), (given.out,))
    present = None if given.start is None else read_calibration(given.start)
    source, make = open_for_calibration(given.input, given.start, given.poses, given.no_poses)
    with progress("reading", given.json) as report:
        found = refine.refine(source, make, report)
    drawn = write_overlay(overlay, found.material, found.camera_fits)
    if found.changed:
        write_calibration(given.out, refine.to_calibration(found, source, present))
    else:
        say("nothing is better than the present calibration; none was written")
    result = refine.to_json(found) | {
        "calibration": str(given.out) if found.changed else None,
        "overlay": str(overlay) if drawn else None,
    }
    if given.json:
        print_json(result)
    else:
        print(refine.to_text(found))
        print("\n".join(f"{name}  {path}" for name, path in result.items() if isinstance(path, str)))
    return DONE if found.changed else FELL_SHORT
