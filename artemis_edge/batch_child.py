"""One recording of a batch mapped in a process of its own: started here or by a worker of a cluster.

``python -m artemis_edge.batch_child TASK PARENT``: the task is JSON, the parent a process id. Lines on stdout are JSON:
``done``, ``total`` and ``note`` while it works, at the end ``report`` and ``warnings``, or ``error`` with its exit
``code``. It ends when its parent does: what a killed worker had begun must not go on beside the one that does it again.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import IO, Any

import msgspec
from msgspec import Struct

from artemis_edge.config import from_toml, to_toml
from artemis_edge.errors import InputError, RunError, UserError
from artemis_edge.orphans import end_with_the_parent
from artemis_edge.progress import now_and_then
from artemis_edge.runtime import Request, reprocess

_SAY_S = 1.0
_LEFT_OVER = (".scratch-*", ".*.part", ".*.old")


class Task(Struct, frozen=True):
    """A Request as text. ``orphaned`` is the signal that ends the child when its parent dies."""

    input: str
    out: str
    config: str
    poses: str | None
    own_odometry: bool
    start: int
    stop: int | None
    holdout: int
    queries: tuple[str, ...]
    model: str
    go_on: str | None
    orphaned: int = signal.SIGTERM

    @classmethod
    def of(cls, request: Request, orphaned: int = signal.SIGTERM) -> Task:
        """Paths become absolute: a worker is in another folder."""
        r = request
        return cls(
            str(r.input.resolve()), str(r.out.resolve()), to_toml(r.config),
            None if r.poses is None else str(r.poses.resolve()),
            r.own_odometry, r.start, r.stop, r.holdout, r.queries, r.model,
            None if r.go_on is None else str(r.go_on.resolve()), orphaned,
        )  # fmt: skip

    def request(self) -> Request:
        """Inverse of ``of``."""
        return Request(
            Path(self.input), Path(self.out), from_toml(self.config),
            None if self.poses is None else Path(self.poses),
            self.own_odometry, self.start, self.stop, self.holdout, self.queries, self.model,
            None if self.go_on is None else Path(self.go_on),
        )  # fmt: skip


class Done(Struct, frozen=True):
    """How it ended: ``report`` and ``warnings``, or the sentence ``error`` with its exit ``code``."""

    report: dict[str, Any] = {}
    warnings: tuple[str, ...] = ()
    error: str = ""
    code: int = 0

    def fault(self) -> UserError | None:
        """The error as it would have been raised here."""
        if not self.error:
            return None
        return InputError(self.error) if self.code == InputError.exit_code else RunError(self.error)


class Child:
    """The process. ``progress`` is (done, total, note), ``result`` how it ended, None before."""

    def __init__(self, task: Task) -> None:
        self.progress = (0, 0, "")
        self.result: Done | None = None
        self._said = tempfile.TemporaryFile("w+")  # noqa: SIM115  (closed by the thread that reads to the end)
        self.process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "artemis_edge.batch_child",
                msgspec.json.encode(task).decode(),
                str(os.getpid()),
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=self._said,
            text=True,
        )
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """As Ctrl-C: after the present frame, what is mapped is saved."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)

    def kill(self) -> None:
        """At once."""
        self.process.kill()

    def _listen(self) -> None:
        assert self.process.stdout is not None
        found: Done | None = None
        with self.process.stdout as lines, self._said:
            for line in lines:
                value = json.loads(line)
                if "done" in value:
                    self.progress = value["done"], value["total"], value["note"]
                else:
                    found = msgspec.convert(value, Done)
            code = self.process.wait()
            self.result = found or Done(error=_ended(code, _last_line(self._said)), code=1)


def _last_line(file: IO[str]) -> str:
    file.seek(0)
    lines = file.read().strip().splitlines()
    return lines[-1].strip() if lines else ""


def _ended(code: int, last: str) -> str:
    why = f"by signal {-code}" if code < 0 else f"with code {code}"
    return f"its process ended {why}{f' ({last})' if last else ''}; see whether the machine has enough memory"


def main(arguments: list[str]) -> int:
    """The child."""
    task = msgspec.json.decode(arguments[0], type=Task)
    end_with_the_parent(task.orphaned, int(arguments[1]))
    request = task.request()
    _clear(request.out)
    try:
        outcome = reprocess(request, now_and_then(_say_progress, _SAY_S))
    except UserError as error:
        _say({"error": str(error), "code": error.exit_code})
        return error.exit_code
    except KeyboardInterrupt:
        _say({"error": "interrupted", "code": 1})
        return 1
    _say({"report": outcome.report, "warnings": outcome.warnings})
    return 0


def _say_progress(done: int, total: int, note: str = "") -> None:
    _say({"done": done, "total": total, "note": note})


def _say(value: dict[str, Any]) -> None:
    print(json.dumps(value), flush=True)


def _clear(out: Path) -> None:
    """What an earlier run in this folder left half-written when it was killed."""
    for pattern in _LEFT_OVER:
        for path in out.glob(pattern):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
