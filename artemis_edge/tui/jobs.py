"""A command of ours beside the terminal: ``reprocess`` or ``replay`` of a recording, with its progress."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

_PROGRESS = re.compile(r"^(?P<label>[^:]*): (?P<done>\d+) of (?P<total>\d+)")
_BAR = 24
_STOP_S = 5.0


class Job:
    """Runs at once; ``sentence`` is how it does, ``over`` whether it has ended, ``out`` where its map goes."""

    def __init__(self, label: str, words: Sequence[str], out: Path) -> None:
        self.label, self.out = label, out
        self.sentence = f"{label}: getting ready"
        self.over = False
        self._process = subprocess.Popen(
            [sys.executable, "-m", "artemis_edge.cli", *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,  # Ctrl-C is for the terminal
        )
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """As Ctrl-C: what is mapped is saved."""
        if not self.over:
            self.sentence = f"{self.label}: stopping, what is mapped is saved"
            self._process.send_signal(signal.SIGINT)

    def close(self) -> None:
        """The terminal is left: stop, and do not wait for long."""
        self.stop()
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
        self._thread.join(_STOP_S)

    @property
    def report(self) -> str:
        """The report, once it is there."""
        path = self.out / "report.html"
        return str(path) if self.over and path.exists() else ""

    def _listen(self) -> None:
        assert self._process.stderr is not None
        last = ""
        with self._process.stderr as lines:
            for line in lines:
                last = line.strip() or last
                if (found := _PROGRESS.match(line)) is not None:
                    self.sentence = _bar(self.label, int(found["done"]), int(found["total"]))
        code = self._process.wait()
        words = last.removeprefix("artemis-edge: ")
        self.sentence = f"{self.label}: done, in {self.out}" if code == 0 else f"{self.label}: {words}"
        self.over = True


def _bar(label: str, done: int, total: int) -> str:
    filled = round(_BAR * done / max(total, 1))
    return f"{label}: [{'#' * filled}{'.' * (_BAR - filled)}] {done} of {total}"
