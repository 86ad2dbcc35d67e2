"""From the nouns of a question to base classes that a backend can look for, and to their slots in the map."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

from artemis_edge.errors import InputError
from artemis_edge.segmentation.backend import MOST_SLOTS, Prompt, Status, Support
from artemis_edge.segmentation.hints import hint
from artemis_edge.segmentation.query import Phrase, Query, parse
from artemis_edge.segmentation.words import canonical, vocabulary


class Knower(Protocol):
    """A backend, or what is known of one."""

    @property
    def name(self) -> str:
        """Name of the model."""
        ...

    @property
    def classes(self) -> tuple[str, ...]:
        """Its base classes in its own words; empty where it takes any text."""
        ...

    def support(self, text: str) -> Support:
        """Whether it can look for a base class."""
        ...


@dataclass(frozen=True, slots=True)
class Resolved:
    """The base classes that stand for a noun: any of them counts. Empty where the model has none."""

    noun: str
    classes: tuple[str, ...]
    status: Status
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Understanding:
    """A question and what a backend can do about it.

    ``nouns`` by noun, those of landmarks too; ``classes`` are all base classes that need a slot, those of the
    targets first. ``status`` is MATCHED, APPROXIMATE or UNSUPPORTED, with a sentence where it is not the first.
    """

    query: Query
    nouns: dict[str, Resolved]
    classes: tuple[str, ...]
    status: Status
    reason: str = ""


def resolve(noun: str, backend: Knower) -> Resolved:
    """The classes of a backend that a noun means: itself and what it covers, else what covers it (approximate)."""
    words = vocabulary()
    own = {canonical(name) for name in backend.classes}
    direct = backend.support(noun)
    below = tuple(word for word in words.narrower(noun) if word in own)
    if direct.status is not Status.UNSUPPORTED:
        return Resolved(noun, (noun, *below), direct.status, direct.reason)
    if below:
        first = backend.support(below[0])
        return Resolved(noun, below, first.status, first.reason)
    for above in words.broader(noun):
        if above in own:
            reason = f"the model {backend.name} knows '{above}' only, not '{noun}' among them"
            return Resolved(noun, (above,), Status.APPROXIMATE, reason)
    reasons = (direct.reason, hint(noun, own))
    return Resolved(noun, (), Status.UNSUPPORTED, "; ".join(reason for reason in reasons if reason))


def understand(text: str, backend: Knower) -> Understanding:
    """Parse a question and see what the backend can look for; never fails."""
    query = parse(text)
    if not query.targets:
        return Understanding(query, {}, (), Status.UNSUPPORTED, query.reason)
    phrases = [phrase for target in query.targets for phrase in _all(target)]
    nouns = {phrase.noun: resolve(phrase.noun, backend) for phrase in phrases if phrase.noun}
    reasons = [found.reason for found in nouns.values() if found.reason]
    reasons += [f"'{' '.join(phrase.ignored)}' was not understood" for phrase in phrases if phrase.ignored]
    able = [t for t in query.targets if not t.noun or nouns[t.noun].classes]
    if not able:
        return Understanding(query, nouns, (), Status.UNSUPPORTED, "; ".join(reasons))
    classes = tuple(dict.fromkeys(name for found in nouns.values() for name in found.classes))
    vague = reasons or any(phrase.attributes or not phrase.noun for phrase in phrases)
    status = Status.APPROXIMATE if vague else Status.MATCHED
    return Understanding(query, nouns, classes, status, "; ".join(reasons))


def _all(phrase: Phrase) -> Iterator[Phrase]:
    """A phrase and all its landmarks."""
    yield phrase
    for relation in phrase.relations:
        for landmark in relation.landmarks:
            yield from _all(landmark)


class SlotTable:
    """Which base class has which of the 15 slots of the map. A class has one slot however many questions need it.

    A slot that was given back is used again as late as possible: whoever looks at the map may still know its vertices
    by its number.
    """

    def __init__(self) -> None:
        self._slot: dict[str, int] = {}
        self._free = list(range(1, MOST_SLOTS + 1))
        self._users: dict[str, int] = {}

    def acquire(self, classes: Iterable[str]) -> list[int]:
        """Slots of the classes; new ones are taken from the free ones: never used, then free for longest.

        Raises InputError, and takes none, where there are too few.
        """
        wanted = list(dict.fromkeys(classes))
        new = [name for name in wanted if name not in self._slot]
        if len(new) > len(self._free):
            raise InputError(
                f"{len(new)} more classes are needed and {len(self._free)} of {MOST_SLOTS} slots are free; "
                "remove a question"
            )
        self._slot.update(zip(new, self._free, strict=False))
        del self._free[: len(new)]
        for name in wanted:
            self._users[name] = self._users.get(name, 0) + 1
        return [self._slot[name] for name in wanted]

    def release(self, classes: Iterable[str]) -> list[int]:
        """Give classes back; returns the slots that are free now, whose evidence in the map means nothing any more."""
        freed = []
        for name in dict.fromkeys(classes):
            self._users[name] -= 1
            if not self._users[name]:
                del self._users[name]
                freed.append(self._slot.pop(name))
        self._free += freed
        return freed

    def slot(self, name: str) -> int | None:
        """Slot of a class; None where it has none."""
        return self._slot.get(name)

    def is_current(self, prompt: Prompt) -> bool:
        """Whether a prompt's slot still belongs to its class: late masks of a released one are not."""
        return self._slot.get(prompt.text) == prompt.slot

    def prompts(self) -> tuple[Prompt, ...]:
        """What a backend is to look for, by slot."""
        return tuple(
            Prompt(slot, name) for name, slot in sorted(self._slot.items(), key=lambda item: item[1])
        )

    def names(self) -> dict[int, str]:
        """Class by slot."""
        return {prompt.slot: prompt.text for prompt in self.prompts()}
