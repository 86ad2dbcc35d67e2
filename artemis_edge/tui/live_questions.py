"""Questions while a demo walks: the network looks for all it knows, a question chooses what lights up."""

from __future__ import annotations

from collections.abc import Sequence

from artemis_edge.segmentation.registry import open_by_name
from artemis_edge.segmentation.resolve import understand
from artemis_edge.status import QueryStatus, next_colour

#: What the shipped network can tell apart well enough to be asked for.
EVERY_CLASS = ("car", "person", "bench", "tree", "building", "bicycle", "pole", "sign")


class LiveQuestions:
    """``names`` are the classes of the map's slots, from slot 1 on."""

    def __init__(self, names: Sequence[str]) -> None:
        self._slot = {name: slot for slot, name in enumerate(names, start=1)}
        self._asked: dict[str, QueryStatus] = {}

    def order(self, what: str, text: str) -> None:
        """``ask`` or ``forget``; others are not for us."""
        if what == "forget":
            self._asked.pop(text, None)
        elif what == "ask" and text not in self._asked:
            self._asked[text] = self._understood(text)

    def told(self) -> list[QueryStatus]:
        """All that are asked, in order."""
        return list(self._asked.values())

    def _understood(self, text: str) -> QueryStatus:
        colour = next_colour([question.colour for question in self._asked.values()])
        found = understand(text, open_by_name())
        labels = [self._slot[name] for name in found.classes if name in self._slot]
        if not labels:
            reason = found.reason or "this walk's network does not look for it"
            return QueryStatus(text, "unsupported", note=reason, colour=colour)
        return QueryStatus(text, str(found.status), note=found.reason, colour=colour, labels=labels)
