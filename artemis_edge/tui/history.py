"""What was asked before, in a file of the user's own."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

_MOST = 200


def history_file() -> Path:
    """Where the operator's questions are kept (XDG state folder)."""
    base = os.environ.get("XDG_STATE_HOME")
    return (Path(base) if base else Path.home() / ".local" / "state") / "artemis-edge" / "queries"


class History:
    """Lines, oldest first, and a place among them; without a file nothing is kept."""

    def __init__(self, file: Path | None) -> None:
        self._file = file
        self.lines: list[str] = []
        if file is not None:
            with contextlib.suppress(OSError, UnicodeDecodeError):
                self.lines = file.read_text().splitlines()[-_MOST:]
        self._at = len(self.lines)

    def add(self, text: str) -> None:
        """The newest; an older one of the same words goes."""
        text = " ".join(text.split())
        self.lines = [*(line for line in self.lines if line != text), text][-_MOST:]
        self._at = len(self.lines)
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.parent.mkdir(parents=True, exist_ok=True)
                self._file.write_text("\n".join(self.lines) + "\n")

    def step(self, by: int) -> str:
        """The line before (-1) or after (1) the present one; empty beyond the newest."""
        self._at = min(max(self._at + by, 0), len(self.lines))
        return self.lines[self._at] if self._at < len(self.lines) else ""
