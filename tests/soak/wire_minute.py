"""A minute of a session played on the wire by virtual devices, with everything on: what is lost, and what it costs.

    python tests/soak/wire_minute.py [SESSION] [--no-mapping] [--seconds 60]

Without SESSION a walk through the street is simulated first (1280 x 1024 photographs at 10 Hz; some minutes). The
devices run in this process, at their pace: 240,000 points, 400 IMU samples, 10 photographs and the trigger board's
messages a second. CPU is that of each process of the service (all threads, user and system) while the walk lasts:
``receiving`` are the service's threads that read devices and date, cut and hand on what they deliver, ``service`` is
its whole process, ``threads`` each of its threads. Exit code 1 if anything was lost.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec

sys.path.insert(0, str(Path(__file__).parents[2]))

from artemis_edge.service import settings
from artemis_edge.session.verify import verify
from artemis_edge.session.wire_replay import Played, WireRig, read
from tests.livox_ports import reserved
from tests.waiting import until
from tests.walks import given_or_simulated
from tests.wire_service import Service

_PATIENCE_S = 600.0
_LEAD_S = 12.0  # clocks settle in ten
_CONTROL = "MainThread"  # of the service: clients, systemd, the processes of a session
_LOST = ("points_lost", "kernel_drops", "packets_truncated", "imu_lost", "lost", "missing", "triggers_lost")


def cut(played: Played, seconds: float) -> Played:
    """The first seconds of it."""
    del played.windows[round(seconds * 10) :]
    return played


def lost(state: dict[str, Any]) -> Counter[str]:
    """What devices, pairing and recorder have lost so far."""
    found: Counter[str] = Counter(state["lost"])
    for device in state["devices"]:
        for name in _LOST:
            found[f"{device['name']} {name}"] += device["counters"].get(name, 0)
    for camera, counts in state["pairing"].items():
        for name, count in counts.items():
            found[f"{camera} {name}"] += count if name.startswith(("lost", "un")) else 0
    recorder = state["session"]["recorder"]
    for name in ("lost", "left_out", "refused"):
        found[f"recorder {name}"] += recorder.get(name, 0)
    return found


def cpu(state: dict[str, Any]) -> Counter[str]:
    """CPU seconds so far of each process, and of the service's threads."""
    session, threads = state["session"], state["threads_cpu_s"]
    spent = Counter({f"thread {name}": seconds for name, seconds in threads.items()})
    spent["receiving"] = sum(seconds for name, seconds in threads.items() if name != _CONTROL)
    spent["service"], spent["recorder"] = state["cpu_s"], session["recorder"].get("cpu_s", 0.0)
    spent["mapping"] = (session.get("mapping") or {}).get("cpu_s", 0.0)
    return spent


def measure(rig: WireRig, service: Service, seconds: float) -> dict[str, Any]:
    """While the walk lasts."""
    rig.begin(_LEAD_S)
    time.sleep(_LEAD_S)
    state, began = service.state(), time.monotonic()
    before, spent, sent = lost(state), cpu(state), Counter(rig.avia.counters)
    assert rig.over.wait(seconds + 60)
    time.sleep(1.5)  # the recorder tells once a second
    state = service.state()
    took = time.monotonic() - began
    after = cpu(state)
    new = {name: count for name, count in (lost(state) - before).items() if count}
    sent = Counter(rig.avia.counters) - sent
    return {
        "seconds": round(took, 1),
        "packets_sent": sent["packets_sent"],
        "photographs": dict(rig.counts),
        "lost": new,
        "cpu_percent_of_a_core": {k: round(100 * (s - spent[k]) / took, 2) for k, s in after.most_common()},
        "recorder_ring_full": state["session"]["recorder"].get("ring"),
        "mapping": {k: (state["session"]["mapping"] or {}).get(k) for k in ("frames", "waiting", "frame_ms")},
        "load": [round(x, 1) for x in os.getloadavg()],
    }


def play(session: Path, folder: Path, seconds: float, *, mapping: bool) -> dict[str, Any]:
    """Play it to a service of its own; what was measured, and the judgement of the recording."""
    with reserved(), WireRig(cut(read(session), seconds), folder / "rig") as rig:
        config = rig.config()
        wanted = msgspec.structs.replace(config.service, mapping=mapping)
        text = settings.to_toml(msgspec.structs.replace(config, service=wanted))
        (rig.folder / "rig.toml").write_text(text)
        service = Service(rig, folder / "recorded", folder)
        try:
            assert until(service.listens, _PATIENCE_S, 0.2), service.said()
            assert until(lambda: _ready(service, mapping=mapping), _PATIENCE_S, 0.5), service.said()
            report = measure(rig, service, seconds)
            service.process.send_signal(signal.SIGTERM)
            report["code"] = service.process.wait(_PATIENCE_S)
        finally:
            service.end()
    verdicts = verify(folder / "recorded")
    report["problems"] = [problem for verdict in verdicts for problem in verdict.problems]
    report["recorded_mb"] = round(sum(verdict.bytes for verdict in verdicts) / 1e6, 1)
    return report


def _ready(service: Service, *, mapping: bool) -> bool:
    """Recording, photographs are paired, and the kernels of the mapping are compiled."""
    state = service.state()
    paired = all(counts.get("paired", 0) for counts in state["pairing"].values())
    if state["phase"] != "recording" or state["windows"] < 5 or not paired:
        return False
    if not state["session"]["recorder"].get("messages", 0):
        return False
    return not mapping or (state["session"]["mapping"] or {}).get("frames", 0) > 0


def main() -> int:
    """Measure, print, judge."""
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("session", type=Path, nargs="?")
    options.add_argument("--seconds", type=float, default=60.0)
    options.add_argument("--no-mapping", dest="mapping", action="store_false")
    given = options.parse_args()
    with given_or_simulated(given.session, given.seconds) as (session, folder):
        report = play(session, folder, given.seconds, mapping=given.mapping)
    print(json.dumps(report, indent=1))
    return 1 if report["lost"] or report["problems"] or report["code"] else 0


if __name__ == "__main__":
    sys.exit(main())
