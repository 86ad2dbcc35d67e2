"""The service with virtual devices on the wire: CPU of each thread, losses, frame times with and without questions.

    python tests/bench/bench_service.py SESSION [--seconds S] [--query TEXT]... [--still]

SESSION is played by a process of its own; --still: its first window again and again, for as long as it takes.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from tests.control_client import ask
from tests.livox_ports import reserved

_PLAYER = """
import sys, time
from pathlib import Path
from artemis_edge.session.wire_replay import WireRig, read
with WireRig(read(Path(sys.argv[1])), Path(sys.argv[2])) as rig:
    print("ready", flush=True)
    for line in sys.stdin:
        if line.strip() == "begin":
            rig.begin(0.5)
            rig.over.wait()
            print("over", flush=True)
"""


def mapped(state: dict[str, Any]) -> dict[str, Any]:
    """What the mapping says."""
    return dict((state.get("session") or {}).get("mapping") or {})


def measure(given: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """One run."""
    player = subprocess.Popen(
        [sys.executable, "-c", _PLAYER, str(given.session), str(folder / "rig")],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert player.stdin is not None and player.stdout is not None
    assert player.stdout.readline().strip() == "ready"
    words = ["run", "--config", str(folder / "rig" / "rig.toml"), "--session", str(folder / "session")]
    for text in given.query:
        words += ["--query", text]
    service = subprocess.Popen([sys.executable, "-m", "artemis_edge.cli", *words], stderr=subprocess.DEVNULL)
    control = folder / "rig" / "control"
    try:
        while not control.exists() or mapped(ask(control, do="state")["result"]).get("mapped", 0) < 5:
            time.sleep(0.5)
        if not given.still:
            player.stdin.write("begin\n")
            player.stdin.flush()
        return watch(given.seconds, control)
    finally:
        service.send_signal(signal.SIGINT)
        time.sleep(2.0)
        service.send_signal(signal.SIGINT)  # the map is of no use here
        service.wait()
        player.kill()
        player.wait()


def watch(seconds: float, control: Path) -> dict[str, Any]:
    """Counts and times between two looks."""
    first, start = ask(control, do="state")["result"], time.monotonic()
    times: dict[int, float] = {}
    cpus: dict[int, float] = {}
    state = first
    while time.monotonic() - start < seconds:
        time.sleep(1.0)
        state = ask(control, do="state")["result"]
        mapping = mapped(state)
        latest = mapping.get("frame_ms_list", [])
        for k, (ms, cpu_ms) in enumerate(zip(latest, mapping.get("cpu_ms_list", []), strict=True)):
            times[mapping["mapped"] - len(latest) + k] = ms
            cpus[mapping["mapped"] - len(latest) + k] = cpu_ms
    wall = time.monotonic() - start
    since = mapped(first).get("mapped", 0)
    new = [ms for frame, ms in times.items() if frame >= since]
    new_cpu = [ms for frame, ms in cpus.items() if frame >= since]
    before, after = first["threads_cpu_s"], state["threads_cpu_s"]
    share = {name: round((s - before.get(name, 0.0)) / wall * 100, 2) for name, s in after.items()}
    cpu: dict[str, float] = defaultdict(float)
    for name in ("recorder", "mapping", "segmentation"):
        then, now = (look["session"].get(name) or {} for look in (first, state))
        cpu[name] = round((now.get("cpu_s", 0.0) - then.get("cpu_s", 0.0)) / wall * 100, 1)
    return {
        "seconds": round(wall, 1),
        "load": os.getloadavg()[0],
        "service_percent": round((state["cpu_s"] - first["cpu_s"]) / wall * 100, 1),
        "receiving_percent": round(sum(s for name, s in share.items() if name != "MainThread"), 1),
        "threads_percent": dict(sorted(share.items(), key=lambda item: -item[1])),
        "others_percent": dict(cpu),
        "frames": len(new),
        "frame_ms": {q: round(float(np.percentile(new, q)), 1) for q in (50, 99)} if new else {},
        "frame_cpu_ms": {q: round(float(np.percentile(new_cpu, q)), 1) for q in (50, 99)} if new else {},
        "behind_s": mapped(state).get("behind_s"),
        "masks": mapped(state).get("masks", 0) - mapped(first).get("masks", 0),
        "lost": {
            **state["lost"],
            **{d["name"]: d["counters"].get("points_lost", 0) for d in state["devices"]},
        },
        "reduced": state["session"].get("reduced"),
        "sent": state["sent"],
        "pairing": state["pairing"],
        "segmentation": {
            k: v for k, v in (state["session"].get("segmentation") or {}).items() if k != "answers"
        },
        "queries": {q["text"]: [q["status"], q["count"], q["score"]] for q in state["queries"]},
    }


def main() -> None:
    """Print what was measured."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("session", type=Path)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--query", action="append", default=[])
    parser.add_argument("--still", action="store_true")
    given = parser.parse_args()
    with reserved(), tempfile.TemporaryDirectory() as folder:
        print(json.dumps(measure(given, Path(folder)), indent=1))


if __name__ == "__main__":
    main()
