"""The questions of a run: what they need of the network, where the masks come from, what the map answers."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from artemis_edge.export.mesh import Mesh
from artemis_edge.frames import F32, CameraImage
from artemis_edge.highlight import Reply, answer, objects_of
from artemis_edge.segmentation.backend import DenseScores, Grid, Prompt, Status
from artemis_edge.segmentation.engine import HereEngine, ProcessEngine
from artemis_edge.segmentation.query import each_once
from artemis_edge.segmentation.registry import Registry, open_by_name
from artemis_edge.segmentation.resolve import SlotTable, Understanding, understand
from artemis_edge.segmentation.worker import Schedule, Scheduled
from artemis_edge.segmentation.yolo_seg import Thresholds
from artemis_edge.semantic_map import LateMask
from artemis_edge.sight import Sight, without_depth


@dataclass(frozen=True, slots=True)
class Questions:
    """Texts as a backend understands them; ``names`` are the classes that need a slot, from slot 1 on."""

    model: str
    asked: tuple[Understanding, ...]
    names: tuple[str, ...]
    thresholds: Thresholds | None = None

    @classmethod
    def of(cls, texts: Sequence[str], model: str = "", thresholds: Thresholds | None = None) -> Questions:
        """Understand questions with a model of the registry; raises InputError where it cannot be used or the
        questions need more classes than there are slots."""
        backend = Registry().find(model).open()
        asked = tuple(understand(text, backend) for text in each_once(texts))
        slots = SlotTable()
        for question in asked:
            slots.acquire(question.classes)
        return cls(backend.name, asked, tuple(slots.names().values()), thresholds)

    @property
    def prompts(self) -> tuple[Prompt, ...]:
        """What the network is to look for."""
        return tuple(Prompt(slot, name) for slot, name in enumerate(self.names, start=1))

    def segmenter(self, schedule: Schedule, beside: bool = True) -> ScheduledMasks:
        """The network at work on a fixed schedule, so that equal input gives equal maps; ``beside`` the pipeline in
        a process of its own, or here. What is scheduled waits for its masks, so they are read finely."""
        opener = partial(open_by_name, self.model, self.thresholds, fine=True)
        if beside:
            engine = ProcessEngine(opener)
            engine.wait_until_ready()
            return ScheduledMasks(self.names, Scheduled(engine, self.prompts, schedule))
        here = HereEngine(opener())
        return ScheduledMasks(self.names, Scheduled(here, self.prompts, schedule))

    def replies(self, mesh: Mesh, probability: F32) -> list[Reply]:
        """What a labelled mesh answers; ``probability`` float32 (n,) is that of each vertex' label."""
        return answer(self.asked, objects_of(mesh, probability))


def unanswered(questions: Questions, reason: str) -> list[Reply]:
    """Replies of a run that had nothing to look at."""
    return [
        Reply(q.query.text, Status.UNSUPPORTED, q.reason if not q.classes else reason, ())
        for q in questions.asked
    ]


def every_image(count: int, delay: int) -> Schedule:
    """Every ``count``-th image of each camera, the first included, handed over ``delay`` turns later.

    By images and not by turns: a camera may bring one every other frame.
    """
    offered: Counter[str] = Counter()

    def due(turn: int, image: CameraImage) -> int | None:
        offered[image.name] += 1
        return turn + max(delay, 1) if (offered[image.name] - 1) % count == 0 else None

    return due


@dataclass(slots=True)
class ScheduledMasks:
    """A :class:`Scheduled` segmentation as the pipeline takes it."""

    names: Sequence[str]
    work: Scheduled[Sight]

    def offer(self, image: CameraImage, look: Callable[[], Sight]) -> None:
        """An image that may be segmented."""
        self.work.offer(image, look)

    def ready(self) -> list[LateMask]:
        """Masks that are due in this frame."""
        return [LateMask(seen.context, seen.segmentation.dense) for seen in self.work.ready()]

    def drain(self) -> list[LateMask]:
        """All that are left."""
        return [LateMask(seen.context, seen.segmentation.dense) for seen in self.work.drain()]

    def settle(self) -> None:
        """Wait for what the next frame will need; call between frames."""
        self.work.settle()

    def close(self) -> None:
        """End the network's process."""
        self.work.engine.close()


@dataclass(slots=True)
class BlankMasks:
    """Masks without content, of the types of real ones: kernels are compiled with them before the first frame."""

    names: Sequence[str]
    _queue: deque[Sight] = field(default_factory=deque)

    def offer(self, image: CameraImage, look: Callable[[], Sight]) -> None:
        """Take the view."""
        self._queue.append(look())

    def ready(self) -> list[LateMask]:
        """Two masks for every image at once: one as they come, and one as of an image from before its question."""
        slots = tuple(range(len(self.names) + 1))
        scores = DenseScores(slots, np.zeros((4, 4, len(slots)), np.uint8), Grid(0.01, 0.01, 0.0, 0.0))
        out = [LateMask(view, scores) for sight in self._queue for view in (sight, without_depth(sight))]
        self._queue.clear()
        return out

    def drain(self) -> list[LateMask]:
        """What is left."""
        return self.ready()

    def settle(self) -> None:
        """Nothing to wait for."""

    def close(self) -> None:
        """Nothing to end."""
