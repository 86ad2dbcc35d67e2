"""JSON files of maps and of users: whatever is wrong inside is a ValueError."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def read_json(path: Path) -> Any:
    """The value in a file; OSError where it cannot be read, ValueError where it is no JSON or nested too deeply."""
    try:
        return json.loads(path.read_text("utf-8"))
    except RecursionError:
        raise ValueError("nested too deeply") from None
