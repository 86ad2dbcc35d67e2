"""The live questions of the service: what is asked, the slots it takes in the map, and what is told of it."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

from msgspec.structs import replace

from artemis_edge.errors import InputError
from artemis_edge.segmentation.knowledge import Knowledge
from artemis_edge.segmentation.manifest import Manifest
from artemis_edge.segmentation.query import Phrase, same_key, tidied
from artemis_edge.segmentation.resolve import SlotTable, Understanding, understand
from artemis_edge.session.asked import Asked
from artemis_edge.status import Colour, QueryStatus, next_colour

MOST_QUESTIONS = 32
LONGEST = 500  # characters


@dataclass(slots=True)
class _Question:
    understanding: Understanding
    colour: Colour


@dataclass(slots=True)
class Desk:
    """Takes questions and gives them back; ``model`` is the network that looks for them."""

    model: Manifest
    _slots: SlotTable = field(default_factory=SlotTable)
    _asked: dict[str, _Question] = field(default_factory=dict)

    def ask(self, text: object) -> QueryStatus:
        """Ask from now on. What the network cannot look for is listed with the reason and takes no slot.

        Raises InputError for what is no question, and where slots are missing.
        """
        text = tidied(text) if isinstance(text, str) else ""
        if not text:
            raise InputError("write what to look for, for example 'bench' or 'red car'")
        # JSON can say half a character, UTF-8 and the recording cannot
        if any(0xD800 <= ord(letter) < 0xE000 for letter in text):
            raise InputError("this question holds half a character (a lone surrogate); send it as UTF-8")
        if len(text) > LONGEST:
            raise InputError(f"a question has at most {LONGEST} characters; this one has {len(text)}")
        text = self._first_spelling(text)
        if text not in self._asked:
            if len(self._asked) >= MOST_QUESTIONS:
                raise InputError(f"{MOST_QUESTIONS} questions are asked already; remove one")
            found = understand(text, Knowledge(self.model))
            self._slots.acquire(found.classes)
            colour = next_colour([question.colour for question in self._asked.values()])
            self._asked[text] = _Question(found, colour)
        return self._status(text, {})

    def forget(self, text: object) -> None:
        """Ask it no more. Raises InputError where it is not asked."""
        text = self._first_spelling(tidied(text)) if isinstance(text, str) else ""
        if text not in self._asked:
            known = ", ".join(f"'{other}'" for other in self._asked) or "none"
            raise InputError(f"'{text[:60]}' is not among the questions asked ({known})")
        self._slots.release(self._asked.pop(text).understanding.classes)

    def asked(self) -> Asked:
        """As mapping and segmentation need it."""
        return Asked(self.model, tuple(self._asked), self._slots.names())

    def told(self, segmentation: dict[str, Any] | None) -> list[QueryStatus]:
        """All that are asked, in order, with what the segmentation process says of them; None: nothing is recorded."""
        if segmentation is None:
            found = [self._status(text, {}) for text in self._asked]
            return [replace(q, status="waiting") if q.status == "searching" else q for q in found]
        answers = {answer["text"]: answer for answer in segmentation.get("answers", ())}
        done, total = segmentation.get("looking_back", (0, 0))
        note = f"looking back: {done} of {total}" if total else ""
        return [self._status(text, answers.get(text, {}), note) for text in self._asked]

    def _first_spelling(self, text: str) -> str:
        """The question asked already that is the same, else the text itself."""
        key = same_key(text)
        return next((other for other in self._asked if same_key(other) == key), text)

    def _status(self, text: str, answer: dict[str, Any], note: str = "") -> QueryStatus:
        question = self._asked[text]
        found = question.understanding
        if not found.classes:
            return QueryStatus(text, "unsupported", note=found.reason, colour=question.colour)
        labels, count = self._labels(found), int(answer.get("count", 0))
        chosen = needs_choice(found)
        return QueryStatus(
            text,
            str(answer["status"]) if count else "searching",
            count,
            float(answer.get("score", 0.0)),
            question.colour,
            note or str(answer.get("note") or found.reason),
            [(x, y, z) for x, y, z in answer.get("places", ())],
            labels if count or not chosen else [],
            [list(box) for box in answer.get("boxes", ())] if chosen else [],
        )

    def _labels(self, found: Understanding) -> list[int]:
        """Slots of what is meant; landmarks ("next to the bench") do not light up."""
        targets = {phrase.noun for phrase in found.query.targets}
        names = [name for noun in targets if noun in found.nouns for name in found.nouns[noun].classes]
        slots = self._slots.names()
        return [slot for slot, name in slots.items() if name in names] or list(slots)


def needs_choice(found: Understanding) -> bool:
    """Whether not all of a class is meant: only the red ones, the tallest, those next to something."""

    def chooses(phrase: Phrase) -> bool:
        return bool(phrase.attributes or phrase.superlative or phrase.relations or not phrase.noun)

    return any(chooses(phrase) for phrase in found.query.targets)


@dataclass(slots=True)
class Restarts:
    """How often a process may be started again: ``most`` times in ``span_s``."""

    most: int = 5
    span_s: float = 60.0
    _times: list[float] = field(default_factory=list)

    def allowed(self) -> bool:
        """Whether once more is in order; counts it."""
        now = time.monotonic()
        self._times = [t for t in self._times if now - t < self.span_s] + [now]
        return len(self._times) <= self.most
