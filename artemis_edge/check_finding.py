"""What a check found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Status = Literal["ok", "warn", "fail"]


@dataclass(frozen=True, slots=True)
class Finding:
    """``status`` ok, warn (works, but not well) or fail (does not work), and a sentence."""

    name: str
    status: Status
    detail: str
