"""A remote for the terminal that says what it is told to, and the pilot that walks through the pages."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import numpy as np
from textual.pilot import Pilot

from artemis_edge.frames import MeshDelta
from artemis_edge.status import MapStatus, QueryStatus, Status, Stream, SyncStatus
from artemis_edge.tui.app import ArtemisTui, LivePage
from artemis_edge.tui.remote import RemoteError

FULL = Status(
    state="recording",
    seconds=83.4,
    frames=834,
    dropped=2,
    streams=[
        Stream("lidar_0", 240_000, 240_000, 0, state="running"),
        Stream("cam_0", 6.0, 10.0, 3, state="running"),
        Stream("imu", 0.0, 400.0, 0, state="silent", message="no data for 2 s: plug it in again"),
    ],
    sync=SyncStatus("locked", 0.12, {"imu": 18.0}),
    map=MapStatus(120_000, 200_000, 812.0, 640.0),
    frame_ms=[20.0, 60.0, 80.0, 130.0],
    disk_minutes=12.0,
    battery_minutes=4.0,
    degenerate=True,
    coaching=["turn slower"],
    losses={"packets": 3},
    queries=[
        QueryStatus("bench", "matched", 2, 0.91, (255, 0, 0), places=[(1.0, 2.0, 0.0), (5.0, 5.0, 0.0)]),
        QueryStatus("unicorn", "unsupported", note="no model knows it", colour=(0, 255, 0)),
    ],
    overload=["preview"],
)


def delta(block: tuple[int, int, int], points: np.ndarray, label: int = 0, index: int = 0) -> MeshDelta:
    n = len(points)
    return MeshDelta(
        index=index,
        block=np.array([block], np.int32),
        vertex_start=np.array([0, n]),
        triangle_start=np.array([0, 1]),
        vertex_id=np.arange(n),
        position=np.asarray(points, np.float32),
        normal=np.tile(np.array([0, 0, 1], np.float32), (n, 1)),
        colour=np.full((n, 3), 200, np.uint8),
        label=np.full(n, label, np.uint8),
        confidence=np.ones(n, np.float32),
        triangles=np.array([[0, 1, 2]]),
    )


def court() -> list[MeshDelta]:
    """A floor with a wall and something asked for on it, in a grid: large areas of one colour."""
    a, b = np.meshgrid(np.arange(-12, 12, 0.1), np.arange(-12, 12, 0.1))
    floor = np.stack([a.ravel(), b.ravel(), np.full(a.size, -1.5)], axis=1)
    u, v = np.meshgrid(np.arange(-6, 6, 0.05), np.arange(-1.5, 2.5, 0.05))
    wall = np.stack([np.full(u.size, 11.0), u.ravel(), v.ravel()], axis=1)
    bench = np.array([[5.0 + 0.1 * i, 2.0 + 0.1 * j, -1.0] for i in range(12) for j in range(20)])
    found = [delta((0, 0, 0), floor), delta((1, 0, 0), wall), delta((0, 1, 0), bench, label=1)]
    for part, colour in zip(found, ((90, 110, 80), (150, 90, 70), (160, 160, 60)), strict=True):
        part.colour[:] = colour
    return found


class Fake:
    """A remote that says what it is given and remembers what it was told."""

    name = "test"

    def __init__(self, status: Status = FULL) -> None:
        self.now = status
        self.news = [delta((0, 0, 0), np.random.default_rng(1).uniform(-5, 5, (3000, 3)), 1)]
        self.told: list[str] = []
        self.fault = ""

    def status(self) -> Status:
        if self.fault:
            raise RemoteError(self.fault)
        return self.now

    def deltas(self) -> list[MeshDelta]:
        news, self.news = self.news, []
        return news

    def ask(self, text: str) -> str:
        self.told.append(f"ask {text}")
        return f"looking for '{text}'"

    def forget(self, text: str) -> str:
        self.told.append(f"forget {text}")
        return ""

    def command(self, name: str) -> str:
        self.told.append(name)
        return name

    def close(self) -> None:
        self.told.append("close")


def run(
    app: ArtemisTui, script: Callable[[Pilot[None]], Awaitable[None]], size: tuple[int, int] = (80, 24)
) -> None:
    async def all_of_it() -> None:
        async with app.run_test(size=size) as pilot:
            await pilot.pause(0.6)
            await script(pilot)

    asyncio.run(all_of_it())


async def settled(pilot: Pilot[None], true: Callable[[], bool]) -> None:
    """Wait until something holds: what threads do is not counted in steps."""
    for _ in range(100):
        if true():
            return
        await pilot.pause(0.05)
    raise AssertionError("it never came to that")


def live(app: ArtemisTui) -> LivePage:
    page = app.get_screen("live")
    assert isinstance(page, LivePage)
    return page
