"""``artemis-edge replay``: the pipeline fed from a session exactly as it was live."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from artemis_edge.config import Config
from artemis_edge.errors import InputError, RunError
from artemis_edge.mapping_run import Interrupt
from artemis_edge.progress import Report, silent
from artemis_edge.runtime import MakeMapper, pipeline
from artemis_edge.session import feed
from artemis_edge.session.results import prepare, scratch
from artemis_edge.session.stream_mapping import StreamMapping, has_questions, warm_up
from artemis_edge.session.verify import session_config

_SECOND_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Pace:
    """``speed`` times as fast as it was recorded; 0: as fast as it goes."""

    speed: float = 0.0
    sleep: Callable[[float], None] = time.sleep
    clock: Callable[[], float] = time.monotonic

    def waiter(self) -> Callable[[int], None]:
        """Called with the log time of each message; waits until it is due."""
        start: list[tuple[float, int]] = []

        def wait(log_ns: int) -> None:
            if self.speed <= 0:
                return
            if not start:
                start.append((self.clock(), log_ns))
            due = start[0][0] + (log_ns - start[0][1]) / _SECOND_NS / self.speed
            if (left := due - self.clock()) > 0:
                self.sleep(left)

        return wait


def replay(
    session: Path,
    out: Path,
    config: Config | None = None,
    pace: Pace | None = None,
    report: Report = silent,
    make: MakeMapper = pipeline,
) -> dict[str, Any]:
    """Map the messages of ``session`` in their order into ``out``; returns what was saved (StreamMapping.save).

    ``config`` None: the settings that the session was mapped with live. Raises InputError if there is nothing to map,
    RunError if a result cannot be written.
    """
    config = session_config(session) if config is None else config
    questions, stream = has_questions(feed.messages(session))
    prepare(out)
    wait = (pace or Pace()).waiter()
    with scratch(out) as pages, Interrupt() as interrupt:
        warm_up(config, pages / "warm-up", make, questions)
        mapping = StreamMapping(config, pages, make, session.name, questions)
        for sent in stream:
            wait(sent.log_ns)
            if mapping.take(sent):
                done = mapping.assembler.next_index
                report(
                    done,
                    0,
                    f"{mapping.statistics.frame_ms[-1]:.0f} ms" if mapping.statistics.frame_ms else "",
                )
            if interrupt.asked:
                break
        if not mapping.statistics.frame_ms:
            raise InputError(
                f"{session} has no LiDAR frames; 'artemis-edge session info {session}' lists what it has"
            )
        saved = mapping.save(out)
    if saved["fault"]:
        raise RunError(f"{saved['fault']}; kept in {out}: {', '.join(saved['kept'])}")
    return saved
