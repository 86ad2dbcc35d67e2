"""What the service tells of itself, several times a second: the one form that terminal, browser and scripts read.

Fields that are not known are left at their defaults; whoever shows them says "not known", never a guess.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from msgspec import Struct

Colour = tuple[int, int, int]  # red, green, blue, 0..255

#: Of questions, in the order in which they are given away.
_COLOURS: tuple[Colour, ...] = (
    (255, 120, 0), (0, 220, 120), (230, 60, 230), (70, 160, 255), (250, 230, 60), (255, 70, 70), (0, 210, 210),
    (170, 110, 255), (190, 220, 90), (255, 150, 180),
)  # fmt: skip
State = Literal["idle", "checking", "recording", "saving", "fault", "replaying", "done"]


class Stream(Struct, frozen=True):
    """One sensor: its rate, what it lost, how long ago it was heard, what it says of itself."""

    name: str
    hz: float = 0.0
    expected_hz: float = 0.0
    lost: int = 0
    age_s: float = 0.0
    state: str = ""
    message: str = ""


class QueryStatus(Struct, frozen=True):
    """A live question: ``status`` waiting, searching, matched, approximate, unsupported or not found.

    ``labels`` are those of the vertices that are highlighted for it: all of them, or where there are ``boxes`` those
    inside: centre x, y, z, size along, across and up, yaw.
    """

    text: str
    status: str = "searching"
    count: int = 0
    score: float = 0.0
    colour: Colour = (255, 200, 0)
    note: str = ""
    places: list[tuple[float, float, float]] = []
    labels: list[int] = []
    boxes: list[list[float]] = []


class SyncStatus(Struct, frozen=True):
    """``offset_ms`` of images against their triggers, ``skew_ppm`` by clock; ``state`` locked, holdover or none."""

    state: str = "none"
    offset_ms: float = 0.0
    skew_ppm: dict[str, float] = {}


class MapStatus(Struct, frozen=True):
    """How large the map is."""

    vertices: int = 0
    triangles: int = 0
    area_m2: float = 0.0
    resident_mb: float = 0.0


class Status(Struct, frozen=True):
    """Everything at one moment. ``frame_ms`` are the latest frames' times, newest last; ``position`` in world, m."""

    state: State = "idle"
    message: str = ""
    seconds: float = 0.0
    session: str = ""
    frames: int = 0
    frames_total: int = 0
    dropped: int = 0
    streams: list[Stream] = []
    sync: SyncStatus = SyncStatus()
    map: MapStatus = MapStatus()
    frame_ms: list[float] = []
    segmentation_hz: float = 0.0
    disk_minutes: float | None = None
    battery_minutes: float | None = None
    temperature_c: float | None = None
    overload: list[str] = []
    degenerate: bool = False
    coaching: list[str] = []
    losses: dict[str, int] = {}
    queries: list[QueryStatus] = []
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw: float = 0.0
    profile: str = ""
    report: str = ""


def next_colour(used: Sequence[Colour]) -> Colour:
    """For one more question: the first that no other has; where all are taken, in turn."""
    free = (colour for colour in _COLOURS if colour not in used)
    return next(free, _COLOURS[len(used) % len(_COLOURS)])
