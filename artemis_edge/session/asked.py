"""The questions of a session at one moment, as its messages tell them: the message of topics.QUESTIONS."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
from msgspec import Struct

from artemis_edge.segmentation.backend import Prompt
from artemis_edge.segmentation.knowledge import Knowledge
from artemis_edge.segmentation.manifest import Manifest
from artemis_edge.segmentation.resolve import Understanding, understand


class Asked(Struct, frozen=True):
    """All that is asked from now on: ``texts`` in order, ``slots`` the class that each slot of the map holds.

    ``model`` is the manifest of the network, so that whoever replays the session understands the questions as they
    were understood, whether or not the network is there.
    """

    model: Manifest
    texts: tuple[str, ...] = ()
    slots: dict[int, str] = {}

    @classmethod
    def decode(cls, text: str) -> Asked:
        """From the text of a message; raises ValueError where it is none."""
        try:
            return msgspec.json.decode(text, type=cls)
        except msgspec.MsgspecError as error:
            raise ValueError(str(error)) from None

    def plain(self) -> dict[str, object]:
        """What is written."""
        return dict(msgspec.to_builtins(self, str_keys=True))

    @property
    def prompts(self) -> tuple[Prompt, ...]:
        """What the network looks for, by slot."""
        return tuple(Prompt(slot, name) for slot, name in sorted(self.slots.items()))

    def is_current(self, prompt: Prompt) -> bool:
        """Whether the slot of a prompt still holds its class."""
        return self.slots.get(prompt.slot) == prompt.text

    def understood(self) -> list[Understanding]:
        """The questions."""
        knower = Knowledge(self.model)
        return [understand(text, knower) for text in self.texts]


def slots_of(names: Sequence[str], slots: dict[int, str]) -> list[int]:
    """Slots of classes, of those that have one."""
    return [slot for slot, name in slots.items() if name in names]
