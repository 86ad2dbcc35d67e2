"""Kills recorders at random moments: after ``session recover`` every message older than 1.5 s must be there.

python tests/soak/kill_recorder.py [--times 50] [--seed 1]
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from artemis_edge.session.message_ring import MessageRing
from artemis_edge.session.recover import recover
from tests.recordings import START, numbers, publish, sent, start_recorder

_OLD_S = 1.5


def kill_once(folder: Path, after_s: float, rng: random.Random) -> tuple[int, int, int]:
    """Messages sent, that are due, and that were recovered; the recorder is killed ``after_s`` after its start."""
    ring = MessageRing.create(16)
    recorder = start_recorder(ring, folder)
    while not (recorder.hear() or recorder.latest):
        time.sleep(0.01)
    times, start = list[float](), time.monotonic()
    while time.monotonic() - start < after_s:
        publish(ring, sent(len(times), rng.choice([100, 2000, 60_000]), log_ns=START + len(times)))
        times.append(time.monotonic())
        time.sleep(0.004)
    killed = time.monotonic()
    recorder.process.kill()
    recorder.process.wait()
    recorder.channel.socket.close()
    ring.close()
    kept = []
    for path in sorted(folder.glob("*.mcap")):
        before = path.read_bytes()
        kept += numbers(recover(path).copy)
        if path.read_bytes() != before:
            raise SystemExit(f"{path} was altered")
    if kept != list(range(len(kept))):
        raise SystemExit("messages are missing in between")
    return len(times), sum(killed - at > _OLD_S for at in times), len(kept)


def main() -> int:
    """All of them; 1 if a message was lost."""
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--times", type=int, default=50)
    options.add_argument("--seed", type=int, default=1)
    given = options.parse_args()
    rng, missing, spare = random.Random(given.seed), 0, 0
    for k in range(given.times):
        with tempfile.TemporaryDirectory() as folder:
            count, due, kept = kill_once(Path(folder), rng.uniform(0.05, 4.0), rng)
        missing += max(0, due - kept)
        spare += kept - due
        print(f"{k + 1:3d}: {count} sent, {due} due, {kept} recovered", flush=True)
    print(
        f"{given.times} kills: {missing} messages lost that were older than {_OLD_S} s, {spare} younger ones kept"
    )
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
