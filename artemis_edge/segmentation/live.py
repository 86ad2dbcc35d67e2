"""Questions that come and go while the sensor runs: their slots, and masks that are still about what is asked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Generic

from artemis_edge.errors import InputError
from artemis_edge.frames import CameraImage
from artemis_edge.segmentation.backend import BACKGROUND, DenseScores, Prompt
from artemis_edge.segmentation.resolve import Knower, SlotTable, Understanding, understand
from artemis_edge.segmentation.worker import Context, LatestWins, Seen


@dataclass(slots=True)
class LiveQuestions(Generic[Context]):
    """The questions of a live run. ``knower`` is the model, or what is known of it without opening it."""

    knower: Knower
    worker: LatestWins[Context]
    table: SlotTable = field(default_factory=SlotTable)
    asked: dict[str, Understanding] = field(default_factory=dict)

    @property
    def names(self) -> dict[int, str]:
        """Class by slot, of all questions together."""
        return self.table.names()

    def add(self, text: str) -> Understanding:
        """Ask a question from now on; one that cannot be answered needs no slot and is told by its status.

        Raises InputError where it needs more slots than are free.
        """
        if text not in self.asked:
            found = understand(text, self.knower)
            self.table.acquire(found.classes)
            self.asked[text] = found
            self.worker.prompts = self.table.prompts()
        return self.asked[text]

    def remove(self, text: str) -> list[int]:
        """Ask it no more; returns the slots that are free now, whose evidence the map is to forget."""
        if text not in self.asked:
            known = ", ".join(f"'{other}'" for other in self.asked) or "none"
            raise InputError(f"'{text[:60]}' is not among the questions asked ({known})")
        freed = self.table.release(self.asked.pop(text).classes)
        self.worker.prompts = self.table.prompts()
        return freed

    def offer(self, image: CameraImage, context: Context) -> None:
        """An image that may be segmented."""
        self.worker.offer(image, context)

    def ready(self) -> list[Seen[Context]]:
        """Masks that are done, without the layers of classes that nobody asks for any more; call once a frame."""
        return [
            replace(
                seen,
                segmentation=replace(
                    seen.segmentation,
                    dense=current_layers(seen.segmentation.dense, seen.prompts, self.table.is_current),
                ),
            )
            for seen in self.worker.ready()
        ]


def current_layers(
    dense: DenseScores, prompts: tuple[Prompt, ...], is_current: Callable[[Prompt], bool]
) -> DenseScores:
    """The background and the layers of prompts that still hold their slot."""
    valid = {prompt.slot for prompt in prompts if is_current(prompt)}
    kept = [k for k, slot in enumerate(dense.slots) if slot == BACKGROUND or slot in valid]
    if len(kept) == len(dense.slots):
        return dense
    return DenseScores(tuple(dense.slots[k] for k in kept), dense.score[:, :, kept].copy(), dense.grid)
