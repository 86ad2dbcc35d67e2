"""A real terminal to try programs in: a window of a tmux server of its own."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Self

HAS_TMUX = shutil.which("tmux") is not None
_COLOUR = re.compile(r"[34]8;2;(\d+);(\d+);(\d+)")


class Terminal:
    """Runs ``python -m artemis_edge.cli WORDS`` in a terminal of columns x rows that has 24-bit colour."""

    def __init__(
        self,
        words: Sequence[str],
        size: tuple[int, int],
        folder: Path,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._own = tempfile.TemporaryDirectory(prefix="terminal")  # short: a socket's path is
        self._code = folder / "exit-code"
        given = {"COLORTERM": "truecolor", "XDG_STATE_HOME": str(folder), "XDG_CONFIG_HOME": str(folder)}
        settings = [f"{name}={value}" for name, value in {**given, **(environment or {})}.items()]
        command = [
            "env",
            "-u",
            "COLUMNS",
            "-u",
            "LINES",
            "-u",
            "NO_COLOR",
            *settings,
            sys.executable,
            "-m",
            "artemis_edge.cli",
            *words,
        ]
        script = f"{' '.join(map(_quoted, command))}; echo $? >{_quoted(str(self._code))}; sleep 600"
        columns, rows = size
        self._tmux(
            "-f",
            os.devnull,
            "new-session",
            "-d",
            "-x",
            str(columns),
            "-y",
            str(rows),
            "-c",
            str(folder),
            script,
        )
        self._tmux("set-option", "-g", "status", "off")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._tmux("kill-server")
        self._own.cleanup()

    def text(self) -> str:
        """What is on the screen."""
        return self._tmux("capture-pane", "-p")

    def colours(self) -> set[tuple[int, int, int]]:
        """Colours that are on the screen."""
        found = _COLOUR.findall(self._tmux("capture-pane", "-p", "-e"))
        return {(int(r), int(g), int(b)) for r, g, b in found}

    def press(self, *keys: str) -> None:
        """Keys by the names of tmux: ``Enter``, ``Escape``, ``/`` ..."""
        self._tmux("send-keys", *keys)

    def write(self, text: str) -> None:
        """Letters as they are."""
        self._tmux("send-keys", "-l", text)

    def sees(self, pattern: str, seconds: float = 20.0) -> str:
        """The screen once it shows a regular expression; AssertionError with the screen if it never does."""
        end = time.monotonic() + seconds
        while True:
            shown = self.text()
            if re.search(pattern, shown):
                return shown
            assert time.monotonic() < end, f"'{pattern}' is not on the screen:\n{shown}"
            time.sleep(0.1)

    def ends(self, seconds: float = 20.0) -> int:
        """The exit code of the program, once it has ended."""
        end = time.monotonic() + seconds
        while not (self._code.exists() and self._code.read_text().strip()):
            assert time.monotonic() < end, f"it goes on:\n{self.text()}"
            time.sleep(0.1)
        return int(self._code.read_text())

    def _tmux(self, *words: str) -> str:
        return subprocess.run(
            ["tmux", "-S", f"{self._own.name}/tmux", *words],
            capture_output=True,
            text=True,
            check=True,
            timeout=20,
        ).stdout


def _quoted(word: str) -> str:
    return "'" + word.replace("'", "'\\''") + "'"
