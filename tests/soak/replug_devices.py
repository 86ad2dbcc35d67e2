"""Pulls every virtual device and plugs it in again, over and over, while the service records.

python tests/soak/replug_devices.py [--times 5]

Each must be noticed within 1 s and deliver again within 3 s of being back. Exit code 1 otherwise.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests import replug

_DETECTED_S, _RECOVERED_S = 1.0, 3.0


def main() -> int:
    """All devices in turn, so many times."""
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--times", type=int, default=5)
    times = options.parse_args().times
    worst: dict[str, tuple[float, float]] = {}
    with tempfile.TemporaryDirectory() as folder, replug.recording_rig(Path(folder)) as (rig, service):
        for turn in range(times):
            for name, pulled in replug.pull_each(rig, service).items():
                said = f"noticed after {pulled.detected_s:.2f} s, back after {pulled.recovered_s:.2f} s"
                print(f"{turn + 1:3d} {name}: {said}", flush=True)
                before = worst.get(name, (0.0, 0.0))
                worst[name] = max(before[0], pulled.detected_s), max(before[1], pulled.recovered_s)
        seen = replug.Seen()
        replug.finish(service, rig, seen)
    for name, (detected, recovered) in worst.items():
        print(f"worst of {times}: {name} noticed {detected:.2f} s, back {recovered:.2f} s")
    late = [name for name, (d, r) in worst.items() if d > _DETECTED_S or r > _RECOVERED_S]
    return 1 if late or seen.code else 0


if __name__ == "__main__":
    sys.exit(main())
