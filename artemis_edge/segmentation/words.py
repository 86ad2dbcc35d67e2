"""Words for classes: synonyms, plurals, and which word covers which (words.toml)."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources

_ENDINGS_WITH_ES = ("ses", "xes", "zes", "ches", "shes")
_NOT_PLURAL = ("ss", "us", "is")


@dataclass(frozen=True, slots=True)
class Vocabulary:
    """``canonical`` name by every spelling; ``covers``: the narrower words of a word; ``plurals``: irregular ones;
    ``foreign``: names by words of other languages, for hints only."""

    canonical: dict[str, str]
    covers: dict[str, tuple[str, ...]]
    plurals: dict[str, str]
    foreign: dict[str, str]

    def find(self, word: str) -> str | None:
        """Canonical name of a word or phrase in singular or plural; None where it is not known."""
        for form in _singulars(word, self.plurals):
            if form in self.canonical:
                return self.canonical[form]
        return None

    def narrower(self, word: str) -> list[str]:
        """Words that ``word`` covers, directly or through others."""
        found: dict[str, None] = {}
        waiting = list(self.covers.get(word, ()))
        while waiting:
            item = waiting.pop(0)
            if item not in found:
                found[item] = None
                waiting += self.covers.get(item, ())
        return list(found)

    def broader(self, word: str) -> list[str]:
        """Words that cover ``word``, nearest first."""
        found: dict[str, None] = {}
        waiting = [word]
        while waiting:
            item = waiting.pop(0)
            above = [name for name, below in self.covers.items() if item in below and name not in found]
            found.update(dict.fromkeys(above))
            waiting += above
        return list(found)


@lru_cache(maxsize=1)
def vocabulary() -> Vocabulary:
    """The words that ship with the program."""
    text = (resources.files("artemis_edge.segmentation") / "words.toml").read_text("utf-8")
    tree = tomllib.loads(text)
    synonyms, kinds = tree["synonyms"], tree["kinds"]
    canonical = {name: name for name in _nouns(synonyms, kinds, tree["more"]["nouns"])}
    canonical.update({word: name for name, words in synonyms.items() for word in words})
    covers = {name: tuple(below) for name, below in kinds.items()}
    foreign = {
        word: name for name, words in tree["foreign"].items() for word in words if word not in canonical
    }
    return Vocabulary(canonical, covers, tree["plurals"], foreign)


def _nouns(synonyms: dict[str, list[str]], kinds: dict[str, list[str]], more: list[str]) -> Iterable[str]:
    yield from synonyms
    yield from more
    for name, below in kinds.items():
        yield name
        yield from below


def canonical(name: str) -> str:
    """The canonical name of a class, as a model or a person spells it; unknown words in singular, lower case."""
    spelled = " ".join(name.lower().replace("_", " ").split())
    return vocabulary().find(spelled) or singular(spelled)


def singular(word: str) -> str:
    """A word without its plural ending, as the rules of English go."""
    return _singulars(word, vocabulary().plurals)[-1]


def _singulars(word: str, plurals: dict[str, str]) -> list[str]:
    """The word itself and what it may be the plural of, the likeliest last."""
    *before, last = word.split(" ")
    forms = [last]
    if last in plurals:
        forms.append(plurals[last])
    elif last.endswith("ies") and len(last) > 4:
        forms += [last[:-1], last[:-3] + "y"]
    elif last.endswith(_ENDINGS_WITH_ES):
        forms += [last[:-1], last[:-2]]
    elif last.endswith("s") and not last.endswith(_NOT_PLURAL) and len(last) > 2:
        forms.append(last[:-1])
    return [" ".join([*before, form]) for form in forms]
