"""``artemis-edge warm-up``: the kernels compiled now, so that the first mapping does not wait for them."""

from __future__ import annotations

import argparse
from typing import Any

from artemis_edge.commands.common import DONE, command


def add(commands: Any) -> None:
    """Declare the command."""
    text = "compile the kernels of `run` now (once for a version, a minute or two), not at its first start"
    command(commands, "warm-up", run, text)


def run(given: argparse.Namespace) -> int:
    """``artemis-edge warm-up``."""
    import tempfile
    from pathlib import Path

    from artemis_drivers.livox import livox_driver
    from artemis_drivers.livox_avia.settings import AviaConfig
    from artemis_drivers.livox_mid360.settings import Mid360Config

    from artemis_edge._jit import cache_dir
    from artemis_edge.config import Config
    from artemis_edge.progress import say
    from artemis_edge.service.capture import warm_up as warm_up_devices
    from artemis_edge.session.stream_mapping import warm_up

    say("compiling for this machine (once for a version; a minute or two)")
    warm_up_devices(livox_driver([AviaConfig()], [Mid360Config()]).lidars)
    with tempfile.TemporaryDirectory(prefix="artemis-warm-up-") as folder:
        seconds = warm_up(Config(), Path(folder) / "map", questions=True)
    print(f"ready after {seconds:.0f} s; kept in {cache_dir()}")
    return DONE
