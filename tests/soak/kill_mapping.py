"""Kills the mapping while a session is recorded: no message may be lost, and nothing of it may show in the map.

    python tests/soak/kill_mapping.py [SESSION] [--seconds 20] [--times 2]

Two devices never deliver the same bytes twice, so here a session plays the devices: its messages are handed in at
their pace, once undisturbed and once with the mapping killed (SIGKILL) so many times; everything behind that is the
service's own: ring, recorder, mapping, checkpoints. Byte for byte must be equal: what both recordings hold of the
sensors, the maps that were made live, and the maps that ``reprocess`` makes of both recordings. Exit code 1 where one
is not, where a message is lost, or where the mapping has not mapped again within 10 s. Without SESSION a walk through
the street is simulated first.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

sys.path.insert(0, str(Path(__file__).parents[2]))

from artemis_edge.service.live_session import RESULT, LiveSession
from artemis_edge.service.outlet import Outlet
from artemis_edge.service.settings import RunConfig
from artemis_edge.session.feed import messages
from artemis_edge.session.message_ring import MessageRing, Sent
from artemis_edge.session.verify import verify
from artemis_edge.session.wire_replay import WireRig, read
from tests.recordings import numbers
from tests.walks import given_or_simulated

_WITHIN_S = 10.0
_PATIENCE_S = 900.0
_CHECKPOINT_S = 4.0  # some checkpoints in a short session
_TURN_S = 0.01
_OWN = "/artemis/"  # topics of what the service says of itself, with its times
_MAP = ("mesh.ply", "trajectory.tum", "objects.json", "map/blocks.bin")


@dataclass
class Killer:
    """Kills the mapping when it has mapped ``due`` frames; ``again_s`` until another process has mapped a frame."""

    due: list[int]
    again_s: list[float] = field(default_factory=list)
    killed: tuple[float, int] | None = None
    taken_over: int | None = None

    def look(self, mapping: dict[str, Any]) -> None:
        """At what the mapping says."""
        mapped, pid = int(mapping.get("mapped", 0)), int(mapping.get("pid", 0))
        if self.killed is None:
            if self.due and mapped >= self.due[0]:
                self.due.pop(0)
                self.killed = time.monotonic(), pid
                os.kill(pid, signal.SIGKILL)
        elif pid != self.killed[1] and self.taken_over is None:
            self.taken_over = mapped
        elif self.taken_over is not None and mapped > self.taken_over:
            self.again_s.append(time.monotonic() - self.killed[0])
            self.killed = self.taken_over = None


class Run:
    """One session: ``state`` is what it says at its end."""

    def __init__(self, config: RunConfig, folder: Path, killer: Killer) -> None:
        self.folder, self.killer = folder, killer
        self.outlet = Outlet(MessageRing.create(config.service.ring_mb))
        self.session = LiveSession(config, folder, self.outlet, lambda event: None, {})
        self.state: dict[str, Any] = {}
        self.opening = 0  # messages that tell what the session is

    def play(self, sent: list[Sent]) -> None:
        """Hand in the messages at their pace, then save."""
        self.session.begin()
        self.opening = self.outlet.ring.published
        self._turn_until(lambda: self._mapping().get("state") == "mapping")
        begun = time.monotonic_ns() - sent[0].log_ns
        for message in sent:
            self._turn_until(lambda due=begun + message.log_ns: time.monotonic_ns() >= due)  # type: ignore[misc]
            data, due = message.data, begun + message.log_ns
            self.outlet.send_encoded(message.topic, message.ros_type, data, message.stamp_ns, due)
        self._turn_until(lambda: not self.killer.due and self.killer.killed is None)
        self.session.end()
        self._turn_until(lambda: self.session.over)
        self.state = self.session.state()

    def _mapping(self) -> dict[str, Any]:
        return dict(self.session.state()["mapping"] or {})

    def _turn_until(self, reached: Any) -> None:
        end = time.monotonic() + _PATIENCE_S
        while not reached():
            if time.monotonic() > end or self.session.fault:
                raise SystemExit(f"stands still: {self.session.state()}")
            self.session.turn()
            self.killer.look(self._mapping())
            time.sleep(_TURN_S)

    def problems(self) -> list[str]:
        """What must not be, of this run alone."""
        recorder, mapping = self.state["recorder"], self.state["mapping"]
        found = [
            f"recorder {name}: {n}" for name in ("lost", "left_out", "refused") if (n := recorder.get(name))
        ]
        found += [f"mapping missed {n} messages" for n in [mapping.get("missed", 0)] if n]
        found += [self.state["fault"]] if self.state["fault"] else []
        kept = [number for file in sorted(self.folder.glob("*.mcap")) for number in numbers(file)]
        found += ["messages are missing in between"] if kept != list(range(len(kept))) else []
        return found + [text for verdict in verify(self.folder) for text in verdict.problems]

    def sensed(self) -> list[tuple[str, bytes]]:
        """Topic and bytes of what the recording holds besides what the service says of itself."""
        recorded = [sent for sent in messages(self.folder) if sent.number >= self.opening]
        return [(sent.topic, sent.data) for sent in recorded if not sent.topic.startswith(_OWN)]

    def reprocess(self, out: Path) -> Path:
        """Its map, made anew from the recording by the command."""
        words = [sys.executable, "-m", "artemis_edge.cli", "reprocess", str(self.folder), "--out", str(out)]
        subprocess.run(words, check=True, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        return out


def different(one: Path, other: Path) -> list[str]:
    """Files of two maps that are not the same bytes."""
    return [name for name in _MAP if (one / name).read_bytes() != (other / name).read_bytes()]


def compare(session: Path, folder: Path, times: int) -> list[str]:
    """Both runs; what is wrong."""
    played = read(session)
    (folder / "rig").mkdir()
    config = WireRig(played, folder / "rig").config()
    # what gives way under load would be another map, and be told in the recording
    service = msgspec.structs.replace(
        config.service, overload=False, reserve_mb=0, checkpoint_s=_CHECKPOINT_S
    )
    config = msgspec.structs.replace(config, service=service)
    sent, frames = list(messages(session)), len(played.windows)
    killer = Killer([frames * (k + 1) // (times + 1) for k in range(times)])
    quiet, killed = Run(config, folder / "quiet", Killer([])), Run(config, folder / "killed", killer)
    for one in (quiet, killed):
        one.play(sent)
    wrong = [*quiet.problems(), *killed.problems()]
    if killed.state["mapping_restarts"] != times or len(killer.again_s) != times:
        wrong.append(f"{killed.state['mapping_restarts']} restarts after {times} kills")
    wrong += [f"mapping again after {s:.1f} s" for s in killer.again_s if s > _WITHIN_S]
    given = [(message.topic, message.data) for message in sent]
    wrong += [
        f"{one.folder.name}: other messages than were handed in"
        for one in (quiet, killed)
        if one.sensed() != given
    ]
    wrong += [f"{name} of the live map" for name in different(quiet.folder / RESULT, killed.folder / RESULT)]
    maps = [one.reprocess(folder / f"{one.folder.name}_again") for one in (quiet, killed)]
    wrong += [f"{name} of the map made again" for name in different(*maps)]
    again = ", ".join(f"{s:.1f} s" for s in killer.again_s)
    print(f"{len(sent)} messages, {frames} frames; mapping killed {times} times, again after {again}")
    return wrong


def main() -> int:
    """Run both, compare, judge."""
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("session", type=Path, nargs="?")
    options.add_argument("--seconds", type=float, default=20.0)
    options.add_argument("--times", type=int, default=2)
    given = options.parse_args()
    with given_or_simulated(given.session, given.seconds) as (session, folder):
        wrong = compare(session, folder, given.times)
    print(
        "\n".join(wrong)
        or "nothing lost; recordings, live maps and reprocessed maps are the same, byte for byte"
    )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
