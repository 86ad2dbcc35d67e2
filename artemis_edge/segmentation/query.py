"""The language of questions: "car", "red car", "person next to the bench", "the tallest tree".

A question becomes phrases of one noun each, with attributes, at most one superlative and relations to other
phrases. Only nouns need a network (resolve.py); the rest selects among the objects of the map (select.py). Words
that are not understood are kept and told, never guessed.
"""

from __future__ import annotations

import re
import tomllib
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import resources

from artemis_edge.segmentation.words import singular, vocabulary

LONGEST_QUESTION = 200
_MOST_WORDS = 40
_PUNCTUATION = ",;&"
_IN_WORDS = "-'"
_APOSTROPHE = "\u2019"
# They change the direction of what follows, or take no place (Unicode 15, section 23.2); joiners stay: emoji need them
_STEERING = frozenset("\u200b\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2060\u2066\u2067\u2068\u2069\ufeff")
_LENGTH = re.compile(r"([0-9])(c?m)\b")  # "3m" is two words
_NUMBER = re.compile(r"[0-9]{1,4}(\.[0-9]{1,3})?")
_BETWEEN = "between"
_NEAREST, _FARTHEST = ("nearest", "to"), ("farthest", "from")
_DOING = ("ing", "ed")
_COMPARING = ("more_", "less_")
# "person in red" and "car with red" say a colour of the thing itself
_OF_ITSELF = ("inside", "next_to")
_WITHOUT = "without"
_NUMBERS = ("count", "rank")


@dataclass(frozen=True, slots=True)
class Attribute:
    """A colour or size: ``word`` is its canonical name (query.toml)."""

    kind: str
    word: str
    negated: bool = False


@dataclass(frozen=True, slots=True)
class Superlative:
    """``measure`` height, volume, length, width or distance; the most of it, or the least.

    ``count`` of them, from the ``rank``-th on: "the two tallest", "the second tallest".
    """

    measure: str
    most: bool
    count: int = 1
    rank: int = 1


@dataclass(frozen=True, slots=True)
class Relation:
    """How an object lies to others, ``kind`` as in query.toml; ``between`` has two landmarks, others one.

    ``metres``: of "taller than 3 m", which has no landmark, and of "within 2 m of" it (kind ``within``).
    """

    kind: str
    landmarks: tuple[Phrase, ...]
    negated: bool = False
    metres: float = 0.0


@dataclass(frozen=True, slots=True)
class Phrase:
    """What one object is like. ``noun`` is canonical, "" for anything; ``ignored`` words were not understood."""

    noun: str
    attributes: tuple[Attribute, ...] = ()
    superlative: Superlative | None = None
    relations: tuple[Relation, ...] = ()
    ignored: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Query:
    """A question. Without ``targets`` it was not understood, and ``reason`` says why."""

    text: str
    targets: tuple[Phrase, ...]
    reason: str = ""


@dataclass(frozen=True, slots=True)
class _Grammar:
    """Tables from words to what they mean."""

    lead_in: dict[str, str]
    filler: dict[str, str]
    thing: dict[str, str]
    pronoun: dict[str, str]
    negation: dict[str, str]
    join: dict[str, str]
    colours: dict[str, str]
    sizes: dict[str, str]
    superlatives: dict[str, str]
    relations: dict[str, str]
    lighter: dict[str, str]
    parting: dict[str, str]
    counts: dict[str, str]
    ranks: dict[str, str]
    units: dict[str, str]


@lru_cache(maxsize=1)
def _grammar() -> _Grammar:
    tree = tomllib.loads((resources.files("artemis_edge.segmentation") / "query.toml").read_text("utf-8"))
    lists = {key: dict.fromkeys(words, key) for key, words in tree.items() if isinstance(words, list)}
    groups = {
        key: {word: name for name, words in group.items() for word in words}
        for key, group in tree.items()
        if isinstance(group, dict)
    }
    return _Grammar(**lists, **groups)


def parse(text: str) -> Query:
    """Understand a question; never fails."""
    if len(text) > LONGEST_QUESTION:
        return Query(
            text, (), f"a question may have up to {LONGEST_QUESTION} characters; this one has {len(text)}"
        )
    words = tokens(text)
    if not any(word[0].isalpha() for word in words):
        return Query(text, (), "the question has no word; ask for example for 'red car'")
    if len(words) > _MOST_WORDS:
        return Query(text, (), f"a question may have up to {_MOST_WORDS} words; this one has {len(words)}")
    targets = tuple(_phrase(part) for part in _parts(_without_lead_in(words)))
    if any(_is_open_negation(phrase) for phrase in targets):
        return Query(text, (), "a question for what is not something cannot be answered; say what it is")
    named = tuple(phrase for phrase in targets if phrase.noun or _says_something(phrase))
    if not named:
        return Query(text, (), "the question names no object; ask for example for 'red car'")
    return Query(text, named)


def tidied(text: str) -> str:
    """A question as it is kept: single spaces, none of the characters that steer a terminal or the way of writing."""
    kept = (c for c in text if c.isspace() or not (unicodedata.category(c) == "Cc" or c in _STEERING))
    return " ".join("".join(kept).split())


def same_key(text: str) -> str:
    """What is equal for two spellings of one question: case, spaces and invisible characters do not matter."""
    return unicodedata.normalize("NFKC", tidied(text)).casefold()


def each_once(texts: Iterable[str]) -> tuple[str, ...]:
    """Questions tidied, each once, in its first spelling."""
    first: dict[str, str] = {}
    for text in texts:
        first.setdefault(same_key(text), tidied(text))
    return tuple(first.values())


def shown(text: str) -> str:
    """A question as it may be repeated in a line of text: no longer than one may be, nothing that moves the cursor."""
    whole = "".join(character if character.isprintable() else "?" for character in text)
    return whole if len(whole) <= LONGEST_QUESTION else f"{whole[:LONGEST_QUESTION]}..."


def tokens(text: str) -> list[str]:
    """Words in lower case; commas and the like are words of their own, other signs are not words."""
    plain = unicodedata.normalize("NFKC", text).lower().replace(_APOSTROPHE, "'")
    plain = _LENGTH.sub(r"\1 \2 ", plain)
    spaced = "".join(
        character if character.isalnum() or character in _IN_WORDS else
        f" {character} " if character in _PUNCTUATION else
        character if character == "." and _is_decimal(plain, k) else " "
        for k, character in enumerate(plain)
    )  # fmt: skip
    words = (word.strip(_IN_WORDS) for word in spaced.split())
    return [word.removesuffix("'s") for word in words if word]


def _is_decimal(text: str, k: int) -> bool:
    return "0" <= text[k - 1 : k] <= "9" and "0" <= text[k + 1 : k + 2] <= "9"


def _only_attributes(phrase: Phrase) -> bool:
    return bool(phrase.attributes) and not (phrase.noun or phrase.superlative or phrase.relations)


def _says_something(phrase: Phrase) -> bool:
    return bool(phrase.attributes or phrase.superlative or phrase.relations)


def _is_open_negation(phrase: Phrase) -> bool:
    """Whether a "not" belongs to a noun, here or in a landmark."""
    landmarks = (landmark for relation in phrase.relations for landmark in relation.landmarks)
    return "not" in phrase.ignored or any(_is_open_negation(landmark) for landmark in landmarks)


def _match(words: Sequence[str], start: int, table: dict[str, str]) -> tuple[str, int]:
    """What the longest entry of a table that begins there means, and its number of words; "", 0 if none does."""
    for size in range(min(5, len(words) - start), 0, -1):
        found = table.get(" ".join(words[start : start + size]))
        if found is not None:
            return found, size
    return "", 0


def _without_lead_in(words: list[str]) -> list[str]:
    """Without "show me", "where is" and fillers at the start."""
    start = 0
    while True:
        step = _match(words, start, _grammar().lead_in)[1] or _match(words, start, _grammar().filler)[1]
        if not step:
            return words[start:]
        start += step


def _parts(words: list[str]) -> list[list[str]]:
    """Split at "and", "or" and commas, where something with a noun stands on both sides ("red and white car" is one).

    The "and" of "between a and b" belongs to it.
    """
    parts: list[list[str]] = [[]]
    open_between = False
    k = 0
    while k < len(words):
        joined = _match(words, k, _grammar().join)[1]
        if joined and open_between and parts[-1]:
            parts[-1].append("and")
            open_between = False
        elif joined:
            if _has_noun(parts[-1]):
                parts.append([])
        else:
            open_between |= words[k] == _BETWEEN
            parts[-1].append(words[k])
            joined = 1
        k += joined
    if len(parts) > 1 and not _has_noun(parts[-1]):  # "car, red"
        last = parts.pop()
        parts[-1] += last
    return [part for part in parts if part]


def _has_noun(words: Sequence[str]) -> bool:
    """Whether a word stands there that could be the noun: no filler, attribute or relation."""
    grammar = _grammar()
    k = 0
    while k < len(words):
        tables = (
            *(grammar.filler, grammar.colours, grammar.sizes, grammar.superlatives, grammar.negation),
            *(grammar.counts, grammar.ranks),
        )
        step = max(_match(words, k, table)[1] for table in tables)
        if not step:
            return True
        k += step
    return False


def _phrase(words: Sequence[str]) -> Phrase:
    """One object and what it is related to; a landmark may have relations of its own."""
    words = _reordered(words)
    start, kind, size = _first_relation(words)
    if not kind:
        return _simple(words)
    negated = start > 0 and words[start - 1] in _grammar().negation
    target = _simple(words[: start - 1] if negated else words[:start])
    rest = list(words[start + size :])
    metres, taken = _length(rest)
    if taken and kind.startswith(_COMPARING) and not rest[taken:]:
        return replace(target, relations=(Relation(kind, (), negated, metres),))
    if taken and words[start] == "within" and rest[taken : taken + 1] in (["of"], ["from"]):
        landmark = _phrase(rest[taken + 1 :])
        return replace(target, relations=(Relation("within", (landmark,), negated, metres),))
    sides = _sides(rest) if kind == _BETWEEN else [rest]
    landmarks = tuple(_phrase(side) for side in sides if side)
    if not landmarks or (kind == _BETWEEN and len(landmarks) < 2):
        return replace(target, ignored=(*target.ignored, *words[start:]))
    if kind == _WITHOUT:
        kind, negated = "next_to", not negated
    if kind in _OF_ITSELF and not negated and _only_attributes(landmarks[0]):
        return replace(target, attributes=(*target.attributes, *landmarks[0].attributes))
    return replace(target, relations=(Relation(kind, landmarks, negated),))


def _reordered(words: Sequence[str]) -> Sequence[str]:
    """ "closest tree to the bench" as "tree nearest to the bench"."""
    for k in range(len(words)):
        name, size = _match(words, k, _grammar().superlatives)
        if name.endswith("distance"):
            break
        if _match(words, k, _grammar().relations)[1]:
            return words
    else:
        return words
    relation = _NEAREST if name.startswith("least") else _FARTHEST
    for j in range(k + size, len(words)):
        if words[j] == relation[1] and _has_noun(words[k + size : j]):
            return [*words[:k], *words[k + size : j], *relation, *words[j + 1 :]]
        if _match(words, j, _grammar().relations)[1]:
            break
    return words


def _length(words: Sequence[str]) -> tuple[float, int]:
    """Metres that words begin with, "3.5 m", and how many words that are; 0, 0 where they do not."""
    if not words or not _NUMBER.fullmatch(words[0]):
        return 0.0, 0
    unit, size = _match(words, 1, _grammar().units)
    return (float(words[0]) * float(unit), 1 + size) if size else (0.0, 0)


def _sides(words: list[str]) -> list[list[str]]:
    """Left and right of the first "and"; without one ("between the trees") the same stands on both sides."""
    if "and" not in words:
        return [words, words]
    k = words.index("and")
    return [words[:k], words[k + 1 :]]


def _first_relation(words: Sequence[str]) -> tuple[int, str, int]:
    """Place, kind and length of the first relation; "" if there is none."""
    for k in range(len(words)):
        if _match(words, k, _grammar().filler)[1] > 1:  # "in the scene" says nothing
            continue
        kind, size = _match(words, k, _grammar().relations)
        superlative = " ".join(words[k : k + size]) in _grammar().superlatives
        if kind and not (superlative and not _has_noun(words[:k])):  # "the nearest car" is none
            return k, kind, size
    return len(words), "", 0


@dataclass(frozen=True, slots=True)
class _Piece:
    """A word or a few of them: ``role`` colour, size, superlative, count, rank, noun, negation, filler, unknown."""

    role: str
    name: str
    words: tuple[str, ...]


def _pieces(words: Sequence[str]) -> list[_Piece]:
    grammar = _grammar()
    tables = {
        "colour": grammar.colours,
        "size": grammar.sizes,
        "superlative": grammar.superlatives,
        "count": grammar.counts,
        "rank": grammar.ranks,
        "negation": grammar.negation,
        "filler": {**grammar.filler, **grammar.thing, **grammar.pronoun},
    }
    out = []
    k = 0
    while k < len(words):
        hits = [(role, *_match(words, k, table)) for role, table in tables.items()]
        hits.append(("noun", *_noun(words, k)))
        role, name, size = max(hits, key=lambda hit: hit[2])  # the longest; of equals the first
        if not size:
            role, name, size = "unknown", words[k], 1
        out.append(_Piece(role, name, tuple(words[k : k + size])))
        k += size
    return out


def _noun(words: Sequence[str], start: int) -> tuple[str, int]:
    """Canonical name and length of the longest class word that begins there."""
    for size in range(min(3, len(words) - start), 0, -1):
        found = vocabulary().find(" ".join(words[start : start + size]))
        if found is not None:
            return found, size
    return "", 0


def _simple(words: Sequence[str]) -> Phrase:
    """A noun with its attributes."""
    pieces = _numbers(_light_colours(_colour_or_fruit(_pieces(words))))
    noun, ignored = _head(pieces)
    attributes: list[Attribute] = []
    superlative: Superlative | None = None
    negated = False
    for piece in pieces:
        if piece.role == "negation":
            negated = True
        elif piece.role in ("colour", "size"):
            attributes.append(Attribute(piece.role, piece.name, negated))
            negated = False
        elif piece.role == "superlative":
            amount, measure = piece.name.split()
            numbers = {other.role: int(other.name) for other in pieces if other.role in _NUMBERS}
            superlative = Superlative(measure, amount == "most", **numbers)
        elif piece.role in ("noun", "unknown") and negated:
            break  # "not a car": the negation stays open
    if negated:
        ignored = ("not", *ignored)
    return Phrase(noun, tuple(attributes), superlative, (), ignored)


def _numbers(pieces: list[_Piece]) -> list[_Piece]:
    """Numbers mean something beside a superlative only."""
    if any(piece.role == "superlative" for piece in pieces):
        return pieces
    return [replace(p, role="unknown", name=" ".join(p.words)) if p.role in _NUMBERS else p for p in pieces]


def _light_colours(pieces: list[_Piece]) -> list[_Piece]:
    """ "light" before a colour is bright; elsewhere it is what it was taken for."""
    out = list(pieces)
    for k in range(len(pieces) - 1):
        if " ".join(pieces[k].words) in _grammar().lighter and pieces[k + 1].role == "colour":
            out[k] = _Piece("colour", "bright", pieces[k].words)
    return out


def _colour_or_fruit(pieces: list[_Piece]) -> list[_Piece]:
    """ "orange" is a colour before a noun, and the noun itself where none follows."""
    if any(piece.role in ("noun", "unknown") for piece in pieces):
        return pieces
    for k in reversed(range(len(pieces))):
        noun = vocabulary().find(" ".join(pieces[k].words)) if pieces[k].role == "colour" else None
        if noun:
            return [*pieces[:k], _Piece("noun", noun, pieces[k].words), *pieces[k + 1 :]]
    return pieces


def _head(pieces: Sequence[_Piece]) -> tuple[str, tuple[str, ...]]:
    """The noun, and the words around it that were not understood.

    In a run of words the last decides: "bus driver" is no bus. What follows an article or a doing word is not the
    noun any more: in "statue of a person" and "person holding an umbrella" it is the first.
    """
    groups = _groups(pieces)
    named = next((group for group in groups if any(piece.role == "noun" for piece in group)), None)
    chosen = named or (groups[0] if groups else [])
    others = [word for group in groups if group is not chosen for piece in group for word in piece.words]
    if not chosen:
        return "", ()
    if chosen[-1].role == "noun":
        around = [word for piece in chosen[:-1] for word in piece.words]
        return chosen[-1].name, (*around, *others)
    *first, last = [word for piece in chosen for word in piece.words]
    return " ".join([*first, singular(last)]), tuple(others)


def _parts_from_noun(word: str) -> bool:
    return word.endswith(_DOING) or word in _grammar().parting or word[0] in "0123456789"


def _groups(pieces: Sequence[_Piece]) -> list[list[_Piece]]:
    """Nouns and unknown words in runs, parted by fillers, and after a noun by doing words, numbers and the like."""
    groups: list[list[_Piece]] = [[]]
    for piece in pieces:
        doing = piece.role == "unknown" and _parts_from_noun(piece.name)
        if piece.role == "filler":
            groups.append([])
        elif doing and any(before.role == "noun" for before in groups[-1]):
            groups += [[piece], []]
        elif piece.role in ("noun", "unknown"):
            groups[-1].append(piece)
    return [group for group in groups if group]
