"""Which objects of a map a question means: class, then attributes, relations and the superlative.

Colours and sizes of mesh clusters need no network; an answer that rests on them is APPROXIMATE. What cannot be
judged (a word not understood, "behind" without anybody who looks) is left out of the judgement and told.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from artemis_edge.frames import F64
from artemis_edge.segmentation import layout
from artemis_edge.segmentation.backend import Status
from artemis_edge.segmentation.colours import colour_fit
from artemis_edge.segmentation.layout import Box
from artemis_edge.segmentation.query import Attribute, Phrase, Relation, Superlative
from artemis_edge.segmentation.resolve import Understanding

_LEAST_FIT = 0.5
_SIZES: Mapping[str, tuple[str, float]] = {
    "tall": ("height", 1.0),
    "low": ("height", -1.0),
    "big": ("volume", 1.0),
    "small": ("volume", -1.0),
    "long": ("length", 1.0),
    "wide": ("width", 1.0),
    "narrow": ("width", -1.0),
}
_FLAT, _UPRIGHT = 0.4, 1.5
_LIGHTNESS = ("dark", "bright")


class MapObject(Protocol):
    """An object of the map as a question sees it."""

    @property
    def id(self) -> int:
        """Its number."""
        ...

    @property
    def classes(self) -> Mapping[str, float]:
        """Probability by base class."""
        ...

    @property
    def colour(self) -> F64 | None:
        """Mean sRGB colour (3,) 0..255; None where nothing coloured it."""
        ...

    @property
    def box(self) -> Box:
        """Upright box around it, world frame."""
        ...


@dataclass(frozen=True, slots=True)
class Hit:
    """An object that was meant: ``score`` 0..1 and how far the answer goes."""

    id: int
    score: float
    status: Status


@dataclass(frozen=True, slots=True)
class Selection:
    """Hits, best first, and ``status`` of the whole answer: that of the question, NOT_FOUND where there is no hit."""

    hits: tuple[Hit, ...]
    status: Status
    reason: str = ""


@dataclass(slots=True)
class _Search:
    """Objects, what the nouns mean, who looks, and what could not be judged."""

    objects: Sequence[MapObject]
    asked: Understanding
    viewpoint: F64 | None
    left_out: dict[str, None] = field(default_factory=dict)

    def find(self, phrase: Phrase) -> dict[int, float]:
        """Score of each object (by place in ``objects``) that a phrase means."""
        scores = self._named(phrase.noun)
        for relation in phrase.relations:
            scores = self._related(scores, relation)
        scores = self._attributed(scores, phrase.attributes)
        return scores if phrase.superlative is None else self._most(scores, phrase.superlative)

    def _named(self, noun: str) -> dict[int, float]:
        if not noun:
            return dict.fromkeys(range(len(self.objects)), 1.0)
        wanted = self.asked.nouns[noun].classes
        likely = {
            k: max((item.classes.get(name, 0.0) for name in wanted), default=0.0)
            for k, item in enumerate(self.objects)
        }
        return {k: score for k, score in likely.items() if score > 0.0}

    def _attributed(self, scores: dict[int, float], attributes: Sequence[Attribute]) -> dict[int, float]:
        """Any of the colours asked for, all of the sizes and lightnesses, none of what is negated."""
        colours = [a for a in attributes if _is_hue(a) and not a.negated]
        others = [a for a in attributes if not _is_hue(a) or a.negated]
        peers = [self.objects[k] for k in scores]
        out = {}
        for k, score in scores.items():
            fits = [self._fit(self.objects[k], a, peers) for a in others]
            if colours:
                fits.append(max(self._fit(self.objects[k], a, peers) for a in colours))
            fit = min(fits, default=1.0)
            if fit >= _LEAST_FIT:
                out[k] = score * fit
        return out

    def _fit(self, item: MapObject, attribute: Attribute, peers: Sequence[MapObject]) -> float:
        if attribute.kind == "size":
            fit = size_fit(item, attribute.word, peers)
        elif item.colour is None:
            self.left_out["what has no colour in the map was left out"] = None
            return 0.0
        else:
            fit = colour_fit(item.colour, attribute.word)
        return 1.0 - fit if attribute.negated else fit

    def _related(self, scores: dict[int, float], relation: Relation) -> dict[int, float]:
        """Those that have the relation to some landmark; unchanged where it cannot be judged."""
        if relation.metres:
            return self._measured(scores, relation)
        unknown = [p.noun for p in relation.landmarks if p.noun and not self.asked.nouns[p.noun].classes]
        if unknown:  # told by the understanding already
            return scores
        if relation.kind in layout.VIEWED and self.viewpoint is None:
            said = relation.kind.replace("_", " ")
            self.left_out[f"'{said}' depends on who looks from where and was left out"] = None
            return scores
        sides = [list(self.find(landmark)) for landmark in relation.landmarks]
        if relation.kind in ("nearest_to", "farthest_from"):
            return self._extreme(scores, sides[0], 1.0 if relation.kind == "nearest_to" else -1.0)
        out = {}
        for k, score in scores.items():
            fit = self._relation_fit(k, relation.kind, sides)
            fit = 1.0 - fit if relation.negated else fit
            if fit >= _LEAST_FIT:
                out[k] = score * fit
        return out

    def _measured(self, scores: dict[int, float], relation: Relation) -> dict[int, float]:
        """Those that a length in metres is true of: "taller than 3 m", "within 2 m of the bench"."""
        if any(p.noun and not self.asked.nouns[p.noun].classes for p in relation.landmarks):
            return scores  # told by the understanding already
        near = [k for landmark in relation.landmarks for k in self.find(landmark)]
        out = {}
        for k, score in scores.items():
            box = self.objects[k].box
            if relation.landmarks:
                gaps = [layout.gap(box, self.objects[j].box) for j in near if j != k]
                true = min(gaps, default=np.inf) <= relation.metres
            else:
                true = layout.exceeds(relation.kind, _length_of(box, relation.kind), relation.metres)
            if true != relation.negated:
                out[k] = score
        return out

    def _relation_fit(self, k: int, kind: str, sides: Sequence[Sequence[int]]) -> float:
        box = self.objects[k].box
        others = [[self.objects[j].box for j in side if j != k] for side in sides]
        if kind == "between":
            pairs = ((a, b) for a in others[0] for b in others[1] if a is not b)
            return max((layout.between(box, a, b) for a, b in pairs), default=0.0)
        if kind in layout.COMPARED:
            measure = layout.COMPARED[kind]
            own = box.measure(measure)
            return float(any(layout.exceeds(kind, own, other.measure(measure)) for other in others[0]))
        if kind == "far_from":  # far from all of them
            return min((layout.RELATIONS[kind](box, other) for other in others[0]), default=0.0)
        if kind in layout.VIEWED and self.viewpoint is not None:
            seen = (layout.seen_from(self.viewpoint, kind, box, other) for other in others[0])
            return max(seen, default=0.0)
        return max((layout.RELATIONS[kind](box, other) for other in others[0]), default=0.0)

    def _extreme(self, scores: dict[int, float], landmarks: Sequence[int], sign: float) -> dict[int, float]:
        """The one that is nearest to any landmark, or farthest from all of them."""
        reach = {}
        for k in scores:
            gaps = [layout.gap(self.objects[k].box, self.objects[j].box) for j in landmarks if j != k]
            if gaps:
                reach[k] = sign * min(gaps)
        if not reach:
            return {}
        best = min(reach, key=lambda k: (reach[k], k))
        return {best: scores[best]}

    def _most(self, scores: dict[int, float], superlative: Superlative) -> dict[int, float]:
        """The object, or the few, with the most or least of something."""
        if superlative.measure == "distance" and self.viewpoint is None:
            self.left_out["'nearest' and 'farthest' need somebody who looks, and were left out"] = None
            return scores
        if not scores:
            return scores
        value = {k: self._value(self.objects[k].box, superlative.measure) for k in scores}
        sign = -1.0 if superlative.most else 1.0
        ranked = sorted(value, key=lambda k: (sign * value[k], k))
        first = superlative.rank - 1
        return {k: scores[k] for k in ranked[first : first + superlative.count]}

    def _value(self, box: Box, measure: str) -> float:
        if measure == "distance" and self.viewpoint is not None:
            return layout.gap(box, Box(np.asarray(self.viewpoint, float), np.zeros(3)))
        return box.measure(measure)


def _is_hue(attribute: Attribute) -> bool:
    """Of the hues that are asked for any will do; a "dark blue" thing is both."""
    return attribute.kind == "colour" and attribute.word not in _LIGHTNESS


def _length_of(box: Box, kind: str) -> float:
    """What a length in metres is compared with: where nothing else is said, the longest side."""
    measure = layout.COMPARED[kind]
    return float(np.max(box.size)) if measure == "volume" else box.measure(measure)


def size_fit(item: MapObject, word: str, peers: Sequence[MapObject]) -> float:
    """How well a size word fits: against the median of its peers, 0.5 where it is average; shapes by themselves."""
    box = item.box
    if word == "flat":
        return _ratio_fit(_FLAT * box.measure("width"), box.measure("height"))
    if word == "upright":
        return _ratio_fit(box.measure("height"), _UPRIGHT * box.measure("length"))
    measure, sign = _SIZES[word]
    usual = float(np.median([peer.box.measure(measure) for peer in peers]))
    value = box.measure(measure)
    return _ratio_fit(value, usual) if sign > 0 else _ratio_fit(usual, value)


def _ratio_fit(value: float, usual: float) -> float:
    """0.5 where the two are equal, 1 from half as much again on."""
    ratio = value / usual if usual > 0.0 else 1.0
    return float(np.clip(ratio - 0.5, 0.0, 1.0))


def select(asked: Understanding, objects: Sequence[MapObject], viewpoint: F64 | None = None) -> Selection:
    """The objects that a question means, best first. ``viewpoint`` (3,) is where the person who asks stands."""
    if asked.status is Status.UNSUPPORTED:
        return Selection((), Status.UNSUPPORTED, asked.reason)
    search = _Search(objects, asked, viewpoint)
    best: dict[int, float] = {}
    missed: list[str] = []
    for target in asked.query.targets:
        found = search.find(target)
        if not found and target.noun and asked.nouns[target.noun].classes:
            kind = "" if target == Phrase(target.noun) else " of that kind"
            missed.append(f"no '{target.noun}'{kind} was found")
        for k, score in found.items():
            best[k] = max(score, best.get(k, 0.0))
    if best:  # a part of the answer
        search.left_out.update(dict.fromkeys(missed))
    reason = "; ".join([*([asked.reason] if asked.reason else []), *search.left_out])
    status = Status.APPROXIMATE if search.left_out else asked.status
    ranked = sorted(best, key=lambda k: (-best[k], k))
    hits = tuple(Hit(objects[k].id, best[k], status) for k in ranked)
    selection = Selection(hits, status, reason)
    return selection if hits else replace(selection, status=Status.NOT_FOUND)
