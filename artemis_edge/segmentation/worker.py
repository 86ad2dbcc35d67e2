"""Masks beside the pipeline: which images are segmented, and when their masks are handed over.

Live, the latest image wins and masks come when they come (:class:`LatestWins`). A run that must give the same bytes
again fixes both beforehand (:class:`Scheduled`): by a rule, or by the log of a live run.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Generic, TypeVar

from artemis_edge.errors import InputError, RunError
from artemis_edge.export.atomic import write_bytes
from artemis_edge.frames import CameraImage
from artemis_edge.json_file import read_json
from artemis_edge.segmentation.backend import Prompt, Segmentation
from artemis_edge.segmentation.engine import Engine, Job, Result

#: What the caller wants back with the mask of an image: its pose and depth map.
Context = TypeVar("Context")
_NS = 1e9


@dataclass(frozen=True, slots=True)
class Seen(Generic[Context]):
    """A mask, late: of the image taken at ``stamp_ns`` by ``camera``, with what was offered with it."""

    camera: str
    stamp_ns: int
    prompts: tuple[Prompt, ...]
    segmentation: Segmentation
    context: Context


@dataclass(frozen=True, slots=True)
class Handed:
    """A row of the log: the mask of an image was handed over in the ``turn``-th call of ``ready``, from 1."""

    turn: int
    camera: str
    stamp_ns: int


@dataclass(slots=True)
class Tally:
    """What became of the images: ``offered`` in all, ``segmented``, ``skipped`` by choice, ``faulty``."""

    offered: int = 0
    segmented: int = 0
    skipped: int = 0
    faulty: int = 0
    cpu_ms: float = 0.0
    first_fault: str = ""

    def count(self, result: Result) -> None:
        """Take a result into account."""
        self.cpu_ms += result.cpu_ms
        if result.segmentation is None:
            self.faulty += 1
            self.first_fault = self.first_fault or result.fault
        else:
            self.segmented += 1


@dataclass(slots=True)
class _Offer(Generic[Context]):
    image: CameraImage
    prompts: tuple[Prompt, ...]
    context: Context
    due: int = 0
    result: Result | None = None

    def seen(self, segmentation: Segmentation) -> Seen[Context]:
        """As it is handed over."""
        return Seen(self.image.name, self.image.stamp_ns, self.prompts, segmentation, self.context)


@dataclass(slots=True)
class LatestWins(Generic[Context]):
    """The newest image of each camera is segmented when the engine is free; older ones are skipped.

    No call waits. ``most_hz`` bounds the images a second of one camera (0: no bound), by their stamps. Where the
    engine fails, ``fault`` says so and images are skipped from then on.
    """

    engine: Engine
    prompts: tuple[Prompt, ...]
    most_hz: float = 0.0
    tally: Tally = field(default_factory=Tally)
    log: list[Handed] = field(default_factory=list)
    fault: str = ""
    _waiting: dict[str, _Offer[Context]] = field(default_factory=dict)
    _sent: dict[str, int] = field(default_factory=dict)
    _under_way: _Offer[Context] | None = None
    _turn: int = 0

    def offer(self, image: CameraImage, context: Context) -> None:
        """An image that may be segmented; it takes the place of the camera's one that waits."""
        self.tally.offered += 1
        last = self._sent.get(image.name)
        too_soon = self.most_hz > 0 and last is not None and image.stamp_ns - last < _NS / self.most_hz
        if too_soon or self.fault or not self.prompts:
            self.tally.skipped += 1
            return
        # a camera whose image is replaced keeps its place in the queue
        self.tally.skipped += image.name in self._waiting
        self._waiting[image.name] = _Offer(image, self.prompts, context)
        self._send()

    def ready(self) -> list[Seen[Context]]:
        """Masks that are done; call once a frame."""
        self._turn += 1
        out = []
        try:
            result = self.engine.fetch(wait=False)
        except RunError as error:
            self._fail(error)
            return []
        if result is not None and self._under_way is not None:
            done, self._under_way = self._under_way, None
            self.tally.count(result)
            if result.segmentation is not None:
                out.append(done.seen(result.segmentation))
                self.log.append(Handed(self._turn, done.image.name, done.image.stamp_ns))
        self._send()
        return out

    def _send(self) -> None:
        if self.engine.busy or not self._waiting or self.fault:
            return
        name = next(iter(self._waiting))
        self._under_way = self._waiting.pop(name)
        self._sent[name] = self._under_way.image.stamp_ns
        try:
            self.engine.submit(Job(self._under_way.image.encoded, self._under_way.prompts))
        except RunError as error:
            self._fail(error)

    def _fail(self, error: RunError) -> None:
        self.fault = str(error)
        self.tally.skipped += len(self._waiting) + (self._under_way is not None)
        self._waiting.clear()
        self._under_way = None


#: In which turn the mask of an image offered in a turn is handed over; None: it is not segmented.
Schedule = Callable[[int, CameraImage], int | None]


def every(count: int, delay: int) -> Schedule:
    """Images of every ``count``-th turn, handed over ``delay`` turns later."""

    def due(turn: int, image: CameraImage) -> int | None:
        return turn + max(delay, 1) if turn % count == 0 else None

    return due


def as_logged(log: Sequence[Handed]) -> Schedule:
    """The images of a log, in the turns that it says."""
    turns = {(row.camera, row.stamp_ns): row.turn for row in log}

    def due(turn: int, image: CameraImage) -> int | None:
        return turns.get((image.name, image.stamp_ns))

    return due


@dataclass(slots=True)
class Scheduled(Generic[Context]):
    """Which images are segmented and when their masks come is fixed: the same input gives the same map.

    ``settle`` waits for what is due next; call it between frames, so that no frame waits. Raises RunError where the
    engine fails: without its masks the map would be another one.
    """

    engine: Engine
    prompts: tuple[Prompt, ...]
    schedule: Schedule
    tally: Tally = field(default_factory=Tally)
    log: list[Handed] = field(default_factory=list)
    _queue: deque[_Offer[Context]] = field(default_factory=deque)
    _done: list[_Offer[Context]] = field(default_factory=list)
    _turn: int = 0

    def offer(self, image: CameraImage, make_context: Callable[[], Context]) -> None:
        """An image that may be segmented; what comes back with its mask is made now, and only if it is."""
        self.tally.offered += 1
        due = self.schedule(self._turn, image)
        if due is None or not self.prompts:
            self.tally.skipped += 1
            return
        self._queue.append(_Offer(image, self.prompts, make_context(), due))
        self._advance(wait=False)

    def settle(self) -> None:
        """Wait until everything is there that the next turn hands over."""
        while any(offer.due <= self._turn + 1 for offer in self._queue):
            self._advance(wait=True)

    def ready(self) -> list[Seen[Context]]:
        """The masks that are due in this turn, in the order of their images; call once a frame."""
        self.settle()
        self._turn += 1
        return self._take(lambda offer: offer.due <= self._turn)

    def drain(self) -> list[Seen[Context]]:
        """All that is left, at the end of a run."""
        while self._queue:
            self._advance(wait=True)
        self._turn += 1
        return self._take(lambda offer: True)

    def _take(self, wanted: Callable[[_Offer[Context]], bool]) -> list[Seen[Context]]:
        out = []
        for offer in [offer for offer in self._done if wanted(offer)]:
            if offer.result is not None and offer.result.segmentation is not None:
                out.append(offer.seen(offer.result.segmentation))
                self.log.append(Handed(self._turn, offer.image.name, offer.image.stamp_ns))
        self._done = [offer for offer in self._done if not wanted(offer)]
        return out

    def _advance(self, wait: bool) -> None:
        """Fetch what is done, and hand the next over."""
        if self.engine.busy:
            result = self.engine.fetch(wait)
            if result is None:
                return
            offer = self._queue.popleft()
            self.tally.count(result)
            offer.result = result
            self._done.append(offer)
        if self._queue:
            self.engine.submit(Job(self._queue[0].image.encoded, self._queue[0].prompts))


def write_log(path: Path, log: Sequence[Handed]) -> None:
    """Write which mask was handed over when, so that a run can be repeated exactly."""
    write_bytes(path, (json.dumps({"masks": [asdict(row) for row in log]}, indent=1) + "\n").encode())


def read_log(path: Path) -> list[Handed]:
    """Read a log; raises InputError where it is none."""
    try:
        rows = read_json(path)["masks"]
        return [Handed(int(row["turn"]), str(row["camera"]), int(row["stamp_ns"])) for row in rows]
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path} is not a log of masks ({error}); leave it out to use a fixed rule"
        ) from None
