"""Study of the synchronisation: many simulated runs of a minute, in several kinds of trouble.

    .venv/bin/python tests/soak/sync_study.py [--runs 20] [--seconds 60] [--only NAME]

Prints a line for each kind of trouble: the worst run's 99th percentiles, and sums over all runs. Exit code 1
where an image or IMU sample is off by more than 0.2 ms (p99; 1 ms for the LiDAR without its pulse), or a frame
was paired with a wrong trigger. The first 12 s of each run let the clocks settle, and are not judged.
"""

import argparse
import sys

from tests.sync_rig import Outcome, Run, Spec

MOST_MS, MOST_HELD_MS = 0.2, 1.0

TROUBLES: dict[str, dict[str, object]] = {
    "skew, jitter, 5 % of frames lost": {},
    "the same, exponential jitter": {"jitter": "exponential"},
    "the same, half-normal jitter": {"jitter": "half-normal"},
    "missed exposures, CAN loss": {"missed_exposures": 0.02, "lost_events": 0.03},
    "pulse missing for 30 s": {"external_pps": True, "pps_gap": (25.0, 55.0)},
    "counters and clocks wrap": {
        "first_count": 2**24 - 300,
        "first_us": 2**32 - 30_000_000,
        "first_tick": 2**32 - 300_000,
        "first_sample": 60_000,
    },
    "camera restarts": {"camera_restarts_at": 40.0, "armed": False},
}


def study(name: str, runs: int, seconds: float) -> bool:
    outcomes = [Run(Spec(seconds=seconds, **TROUBLES[name]), seed).run() for seed in range(runs)]  # type: ignore[arg-type]
    image, imu, lidar = (max(o.p99_ms(part(o)) for o in outcomes) for part in PARTS)
    wrong = sum(o.wrong_pairs for o in outcomes)
    frames, dated = (
        sum(o.frames for o in outcomes),
        sum(o.sync.counts()["cam"]["paired"] for o in outcomes if o.sync),
    )
    print(
        f"{name:<34} image {image:6.3f}  imu {imu:6.3f}  lidar {lidar:6.3f} ms p99 of the worst run; "
        f"{wrong} wrong of {dated} pairs, {frames - dated} of {frames} frames not dated"
    )
    return image <= MOST_MS and imu <= MOST_MS and lidar <= MOST_HELD_MS and wrong == 0


def _images(outcome: Outcome) -> list[int]:
    return outcome.image_ns


def _samples(outcome: Outcome) -> list[int]:
    return outcome.imu_ns


def _packets(outcome: Outcome) -> list[int]:
    return outcome.lidar_ns


PARTS = (_images, _samples, _packets)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--only", choices=list(TROUBLES))
    options = parser.parse_args()
    names = [options.only] if options.only else list(TROUBLES)
    good = [study(name, options.runs, options.seconds) for name in names]
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())
