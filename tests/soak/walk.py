"""Soak: a virtual walk of 20 minutes. No frame may cost more as the map grows, nor memory pass its budget.

    .venv/bin/python tests/soak/walk.py [--seconds 1200] [--out DIR]

Exit code 1 where the last tenth costs over 1.1 times the second tenth (median CPU), or the resident memory
passes the budget. The scan is thinned (density) so that the recording is made in reasonable time.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from artemis_edge import health
from artemis_edge.compile_ahead import compile_ahead
from artemis_edge.config import Config, load
from artemis_edge.datasets import open_input
from artemis_edge.frames import Odometry
from artemis_edge.mapping_run import Mapper
from artemis_edge.pipeline import Pipeline
from artemis_edge.progress import progress
from artemis_edge.runtime import Request, reprocess

MOST_GROWTH = 1.1
SETTINGS = {"density": "0.2", "camera": "off", "reference": "off", "mesh": "off"}


def soak(seconds: float, out: Path) -> dict[str, float | bool]:
    session = out / "session"
    if not session.exists():  # in a process of its own: its memory is not the mapping's
        sets = [word for key, value in SETTINGS.items() for word in ("--set", f"{key}={value}")]
        words = ["simulate", "street", "--seed", "7", "--seconds", str(seconds), *sets, "--out", str(session)]
        subprocess.run([sys.executable, "-m", "artemis_edge.cli", *words], check=True)
    config = load(sets=["voxel_map.memory_budget_mb=1200"])
    resident: list[float] = []

    class Watched(Pipeline):
        def process(self, frame):  # type: ignore[no-untyped-def]
            delta = super().process(frame)
            resident.append(health.resident_mb())
            return delta

    def make(chosen: Config, odometry: Odometry, pages: Path) -> Mapper:
        resident.clear()  # of the warm-up
        return Watched(chosen, odometry, pages)

    request = Request(session, out / "map", config, poses=session / "truth" / "trajectory.tum")
    source = open_input(session, config.input)
    compile_ahead(request, source, range(len(source)))  # not done for a pipeline of one's own
    with progress("mapping") as report:
        outcome = reprocess(request, report, make=make)
    tenths = np.array_split(np.array(outcome.statistics.cpu_ms), 10)
    second, last = float(np.median(tenths[1])), float(np.median(tenths[-1]))
    budget = config.voxel_map.memory_budget_mb
    return {
        "frames": outcome.report["frames"],
        "cpu_ms_p50_second_tenth": round(second, 2),
        "cpu_ms_p50_last_tenth": round(last, 2),
        "growth": round(last / second, 3),
        "resident_mb_max": round(max(resident), 1),
        "budget_mb": budget,
        "passed": last <= MOST_GROWTH * second and max(resident) <= budget,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=1200.0)
    parser.add_argument(
        "--out", type=Path, help="keep recording and map here; a recording already there is mapped again"
    )
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="artemis-soak-") as scratch:
        found = soak(given.seconds, given.out or Path(scratch))
    print(json.dumps(found, indent=1))
    return 0 if found["passed"] else 1


if __name__ == "__main__":
    sys.exit(main())
