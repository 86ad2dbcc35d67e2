"""``artemis-edge rig``: the rig's device files, and calibrations made with other tools."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from artemis_edge.commands.common import DONE, command, json_option, print_json


def add(commands: Any) -> None:
    """Declare ``rig``."""
    group = commands.add_parser("rig", help="settings of the rig's devices, and its calibration")
    actions = group.add_subparsers(title="actions", metavar="ACTION", required=True)
    show = command(actions, "show", run_show, "validate a rig profile and show what it sets")
    show.add_argument("profile", metavar="PROFILE", help="a file, or a profile that ships: field, bench ...")
    json_option(show)
    kalibr = command(actions, "import-kalibr", run_kalibr, "a calibration from kalibr's camchain-imucam file")
    kalibr.add_argument("chain", type=Path, metavar="CAMCHAIN.yaml")
    kalibr.add_argument(
        "--base", type=Path, metavar="CALIBRATION.toml", help="has T_imu_lidar; the rest of it is kept"
    )
    fast = command(actions, "import-fast-livo2", run_fast_livo2, "a calibration from FAST-LIVO2's YAML files")
    fast.add_argument("rig", type=Path, metavar="AVIA.yaml")
    fast.add_argument("lens", type=Path, metavar="CAMERA.yaml")
    for parser in (kalibr, fast):
        parser.add_argument("--out", type=Path, required=True, metavar="CALIBRATION.toml")


def run_show(given: argparse.Namespace) -> int:
    """``artemis-edge rig show``."""
    import msgspec
    import tomli_w

    from artemis_edge.config import without_none
    from artemis_edge.devices.rig_file import load_rig

    rig = load_rig(given.profile)
    parts = {
        "lidar": rig.lidars, "imu": rig.imu, "camera": rig.cameras, "trigger": rig.trigger,
        "calibration": rig.calibration,
    }  # fmt: skip
    tree = {name: msgspec.to_builtins(part) for name, part in parts.items() if part is not None}
    if given.json:
        print_json(tree | {"sha256": rig.digests()})
    else:
        print(tomli_w.dumps(without_none(tree)), end="")
        print("\n".join(f"# {digest}  {name}" for name, digest in rig.digests().items()))
    return DONE


def run_kalibr(given: argparse.Namespace) -> int:
    """``artemis-edge rig import-kalibr``."""
    from artemis_edge.devices.calibration import Calibration, read_calibration, write_calibration
    from artemis_edge.devices.importers import from_kalibr

    base = Calibration() if given.base is None else read_calibration(given.base)
    write_calibration(given.out, from_kalibr(given.chain, base))
    if given.base is None:
        print("note: without --base the LiDAR is taken to sit where the IMU is")
    print(given.out)
    return DONE


def run_fast_livo2(given: argparse.Namespace) -> int:
    """``artemis-edge rig import-fast-livo2``."""
    from artemis_edge.devices.calibration import write_calibration
    from artemis_edge.devices.importers import from_fast_livo2

    write_calibration(given.out, from_fast_livo2(given.rig, given.lens))
    print(given.out)
    return DONE
