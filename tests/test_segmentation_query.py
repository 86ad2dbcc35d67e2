"""The language of questions: words, phrases, slots, and selecting among the objects of a map."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from artemis_edge.errors import InputError
from artemis_edge.frames import F64, U8
from artemis_edge.segmentation.attribute import AttributeBackend, shape_scores
from artemis_edge.segmentation.backend import Prompt, Segmentation, Status, Support
from artemis_edge.segmentation.colours import colour_fit
from artemis_edge.segmentation.layout import Box, between, gap, gap_above, seen_from
from artemis_edge.segmentation.query import Attribute, Superlative, parse, shown
from artemis_edge.segmentation.resolve import SlotTable, understand
from artemis_edge.segmentation.select import Selection, select
from artemis_edge.segmentation.words import canonical, vocabulary


@dataclass
class Closed:
    """A backend that knows a few classes."""

    classes: tuple[str, ...] = ("car", "person", "bench", "tree", "truck", "ground")
    name: str = "small"

    def support(self, text: str) -> Support:
        if text in {canonical(name) for name in self.classes}:
            return Support(Status.MATCHED)
        return Support(Status.UNSUPPORTED, f"the model {self.name} does not know '{text}'")

    def segment(self, image: U8, prompts: Sequence[Prompt]) -> Segmentation:
        raise NotImplementedError


@dataclass
class Thing:
    """An object of a map."""

    id: int
    classes: Mapping[str, float]
    box: Box
    colour: F64 | None = field(default=None)


def thing(
    number: int, name: str, x: float, y: float, size: Sequence[float], colour: Sequence[int] = ()
) -> Thing:
    box = Box(np.array([x, y, size[2] / 2]), np.array(size, float))
    return Thing(number, {name: 0.9}, box, np.array(colour, float) if colour else None)


def scene() -> list[Thing]:
    """Two cars, a bench with a person beside it, another person far away, two trees."""
    return [
        thing(1, "car", 0, 0, (4, 1.8, 1.5), (170, 30, 35)),
        thing(2, "car", 10, 0, (4, 1.8, 1.5), (40, 60, 150)),
        thing(3, "bench", 0, 6, (1.8, 0.6, 0.9), (110, 80, 50)),
        thing(4, "person", 1.5, 6, (0.5, 0.5, 1.7)),
        thing(5, "person", 20, 6, (0.5, 0.5, 1.8)),
        thing(6, "tree", 5, 12, (3, 3, 8)),
        thing(7, "tree", -5, 12, (3, 3, 6)),
    ]


def ask(text: str, viewpoint: F64 | None = None) -> Selection:
    return select(understand(text, Closed()), scene(), viewpoint)


def ids(text: str, viewpoint: F64 | None = None) -> list[int]:
    return [hit.id for hit in ask(text, viewpoint).hits]


# --- words


@pytest.mark.parametrize(
    ("said", "meant"),
    [
        ("Cars", "car"), ("people", "person"), ("pedestrians", "person"), ("buses", "bus"), ("benches", "bench"),
        ("motorbike", "motorcycle"), ("traffic_light", "traffic light"), ("bookshelves", "bookshelf"),
        ("sofas", "couch"), ("glasses", "glass"), ("bus", "bus"), ("grass", "grass"), ("skis", "skis"),
        ("daisies", "daisy"), ("cacti", "cacti"), ("", ""),
    ],
)  # fmt: skip
def test_words_have_one_canonical_name(said: str, meant: str) -> None:
    assert canonical(said) == meant


def test_a_canonical_name_is_its_own() -> None:
    words = vocabulary()
    assert all(words.canonical[name] == name for name in words.canonical.values())
    assert not set(words.covers) - set(words.canonical)


def test_broader_and_narrower_are_opposites() -> None:
    words = vocabulary()
    for name in words.covers:
        for below in words.narrower(name):
            assert name in words.broader(below)


# --- phrases


def test_attributes_and_superlatives() -> None:
    (phrase,) = parse("Show me all the big red and white cars!").targets
    assert phrase.noun == "car"
    assert phrase.attributes == (
        Attribute("size", "big"),
        Attribute("colour", "red"),
        Attribute("colour", "white"),
    )
    (phrase,) = parse("the tallest tree").targets
    assert phrase.superlative == Superlative("height", True)


def test_relations_nest_to_the_right() -> None:
    (phrase,) = parse("person near the bench under the tallest tree").targets
    (near,) = phrase.relations
    (bench,) = near.landmarks
    assert (phrase.noun, near.kind, bench.noun) == ("person", "next_to", "bench")
    (under,) = bench.relations
    assert under.kind == "under"
    assert under.landmarks[0].superlative == Superlative("height", True)


def test_between_has_two_landmarks() -> None:
    (phrase,) = parse("bench between the tree and the car").targets
    assert [landmark.noun for landmark in phrase.relations[0].landmarks] == ["tree", "car"]


@pytest.mark.parametrize(
    ("text", "nouns"),
    [
        ("car and person", ["car", "person"]),
        ("dogs, cats or birds", ["dog", "cat", "bird"]),
        ("where are the traffic lights?", ["traffic light"]),
        ("car door", ["door"]),  # and never the whole car
        ("bus stop", ["bus stop"]),
        ("the orange", ["orange"]),
        ("orange car", ["car"]),
        ("people sitting on benches", ["person"]),
        ("something red", [""]),
        ("statue of a person", ["statue"]),
        ("all of the cars", ["car"]),
        ("person holding umbrella", ["person"]),
        ("the person holding an umbrella", ["person"]),
        ("tree taller than the car", ["tree"]),  # and never the car
        ("person 2 m from the bench", ["person"]),
        ("person similar to bench", ["person similar"]),  # not understood, and never the bench
        ("light green car", ["car"]),
        ("street light", ["lamp post"]),
        ("person nearest the bench", ["person"]),
        ("the nearest bench", ["bench"]),
    ],
)
def test_the_noun_of_a_phrase(text: str, nouns: list[str]) -> None:
    assert [phrase.noun for phrase in parse(text).targets] == nouns


def test_colours_of_the_thing_itself() -> None:
    (phrase,) = parse("person in red").targets
    assert (phrase.noun, phrase.attributes, phrase.relations) == ("person", (Attribute("colour", "red"),), ())
    (phrase,) = parse("car, red").targets
    assert (phrase.noun, phrase.attributes) == ("car", (Attribute("colour", "red"),))
    (phrase,) = parse("person in the red car").targets
    assert phrase.relations[0].landmarks[0].noun == "car"


def test_between_things_of_a_kind() -> None:
    assert ids("bench between the trees") == []
    middle = thing(9, "bench", 0, 12, (1.8, 0.6, 0.9))
    found = select(understand("bench between the trees", Closed()), [*scene(), middle])
    assert [hit.id for hit in found.hits] == [9]


def test_negations() -> None:
    assert parse("cars that are not red").targets[0].attributes == (Attribute("colour", "red", True),)
    assert parse("person without a backpack").targets[0].relations[0].negated
    assert "not something" in parse("not a car").reason
    assert "not something" in parse("person next to not a car").reason
    assert "not something" in parse("everything except the ground").reason
    both = (Attribute("colour", "red", True), Attribute("colour", "blue", True))
    assert parse("neither red nor blue car").targets[0].attributes == both


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "no word"),
        ("   ", "no word"),
        ("🚗🚗", "no word"),
        ("12 34", "no word"),
        ("car " * 2500, "up to 200 characters; this one has 10000"),
        ("a" * 10000, "up to 200 characters"),
        ("x " * 99, "up to 40 words"),
        ("the the the", "names no object"),
        ("next to", "names no object"),
        ("between", "names no object"),
    ],
)
def test_what_cannot_be_understood_is_told(text: str, reason: str) -> None:
    found = parse(text)
    assert found.targets == ()
    assert reason in found.reason
    asked = understand(text, Closed())
    assert asked.status is Status.UNSUPPORTED
    assert select(asked, scene()).status is Status.UNSUPPORTED


def test_a_question_is_repeated_without_what_a_terminal_would_obey() -> None:
    assert shown("red \x1b[2Jcar\n") == "red ?[2Jcar?"
    assert shown("a" * 10000) == "a" * 200 + "..."
    assert shown("🚗 Bäume") == "🚗 Bäume"


_WORDS = st.sampled_from(
    [
        "car",
        "red",
        "not",
        "the",
        "next",
        "to",
        "between",
        "and",
        "tallest",
        "of",
        "in",
        "front",
        "orange",
        ",",
        "but",
        "second",
        "two",
        "taller",
        "than",
        "within",
        "2.5",
        "m",
        "light",
        "closest",
        "from",
        "🚗",
        "x",
    ]
)


@settings(max_examples=150, deadline=None)
@given(st.one_of(st.text(max_size=80), st.lists(_WORDS, max_size=12).map(" ".join)))
def test_any_text_is_answered(text: str) -> None:
    found = ask(text)
    assert (found.reason == "") <= (found.status in (Status.MATCHED, Status.NOT_FOUND, Status.APPROXIMATE))
    assert (len(found.hits) > 0) == (found.status in (Status.MATCHED, Status.APPROXIMATE))


# --- what a backend can do


def test_a_wider_word_is_answered_by_what_it_covers() -> None:
    asked = understand("vehicles", Closed())
    assert asked.status is Status.MATCHED
    assert set(asked.classes) == {"car", "truck"}


def test_a_narrower_word_is_answered_approximately() -> None:
    asked = understand("woman", Closed())
    assert (asked.status, asked.classes) == (Status.APPROXIMATE, ("person",))
    assert "knows 'person' only" in asked.reason


def test_unknown_words_are_not_guessed() -> None:
    assert understand("zorblax", Closed()).status is Status.UNSUPPORTED
    assert understand("giraffe", Closed()).status is Status.UNSUPPORTED
    asked = understand("rusty car", Closed())
    assert asked.status is Status.APPROXIMATE
    assert "'rusty' was not understood" in asked.reason


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("persn", "did you mean 'person'?"),
        ("red cra", "did you mean 'car'?"),
        ("pedestrain", "did you mean 'pedestrian'?"),
        ("Bäume", "understood in English: try 'tree'"),
        ("Person neben der Bank", "understood in English: try 'person' or 'bench'"),
        ("木", "understood in English"),
        ("giraffe", ""),  # a word that is known, and no slip
        ("zorblax", ""),
    ],
)
def test_what_may_have_been_meant_is_told_and_not_acted_upon(text: str, said: str) -> None:
    asked = understand(text, Closed())
    assert (asked.status, asked.classes) == (Status.UNSUPPORTED, ())
    assert asked.reason.endswith(said)
    assert said or ";" not in asked.reason


def test_landmarks_need_slots_and_may_be_unknown() -> None:
    assert understand("person next to the bench", Closed()).classes == ("person", "bench")
    asked = understand("person next to the unicorn", Closed())
    assert (asked.status, asked.classes) == (Status.APPROXIMATE, ("person",))
    assert [hit.id for hit in select(asked, scene()).hits] == [4, 5]


def test_slots_are_shared_and_given_back() -> None:
    table = SlotTable()
    assert table.acquire(["car", "person"]) == [1, 2]
    assert table.acquire(["person", "bench"]) == [2, 3]
    assert table.release(["car", "person"]) == [1]
    assert table.slot("car") is None
    assert not table.is_current(Prompt(1, "car"))
    assert table.acquire(["tree"]) == [4]
    assert table.names() == {2: "person", 3: "bench", 4: "tree"}
    assert table.prompts()[-1] == Prompt(4, "tree")
    assert (
        table.acquire([f"thing {k}" for k in range(12)])[-1] == 1
    )  # given back, used when there is no other


def test_a_full_table_takes_nothing() -> None:
    table = SlotTable()
    table.acquire([f"thing {k}" for k in range(14)])
    with pytest.raises(InputError, match="1 of 15 slots are free"):
        table.acquire(["one", "two"])
    assert table.acquire(["thing 3", "one"]) == [4, 15]


# --- selecting


@pytest.mark.parametrize(
    ("text", "expected", "status"),
    [
        ("car", [1, 2], Status.MATCHED),
        ("red car", [1], Status.APPROXIMATE),
        ("red and blue cars", [1, 2], Status.APPROXIMATE),
        ("car that is not red", [2], Status.APPROXIMATE),
        ("green car", [], Status.NOT_FOUND),
        ("person next to the bench", [4], Status.MATCHED),
        ("person not next to the bench", [5], Status.MATCHED),
        ("the tallest tree", [6], Status.MATCHED),
        ("shortest tree", [7], Status.MATCHED),
        ("car nearest to the bench", [1], Status.MATCHED),
        ("car closest the bench", [1], Status.MATCHED),
        ("person farthest from the bench", [5], Status.MATCHED),
        ("person far from the cars", [5], Status.MATCHED),
        ("car between the bench and the tree", [], Status.NOT_FOUND),
        ("something brown", [3], Status.APPROXIMATE),
        ("dark blue car", [2], Status.APPROXIMATE),
        ("light red car", [], Status.NOT_FOUND),
        ("the two tallest trees", [6, 7], Status.MATCHED),
        ("second tallest tree", [7], Status.MATCHED),
        ("the third tallest tree", [], Status.NOT_FOUND),
        ("the closest car to the bench", [1], Status.MATCHED),
        ("the farthest person from the bench", [5], Status.MATCHED),
        ("trees taller than the car", [6, 7], Status.MATCHED),
        ("tree shorter than the tree", [7], Status.MATCHED),
        ("trees higher than 6.5m", [6], Status.MATCHED),
        ("trees not higher than 6.5 metres", [7], Status.MATCHED),
        ("something bigger than 3 m", [1, 2, 6, 7], Status.APPROXIMATE),
        ("person within 90 cm of the bench", [4], Status.MATCHED),
        ("person not within 1 m of the bench", [5], Status.MATCHED),
        ("person within 2 m of the unicorn", [4, 5], Status.APPROXIMATE),
        ("truck", [], Status.NOT_FOUND),
        ("giraffe", [], Status.UNSUPPORTED),
        ("car and person", [1, 2, 4, 5], Status.MATCHED),
        ("car and truck", [1, 2], Status.APPROXIMATE),
    ],
)
def test_selection(text: str, expected: list[int], status: Status) -> None:
    found = ask(text)
    assert (sorted(hit.id for hit in found.hits), found.status) == (expected, status)


def test_what_of_several_things_is_not_there_is_told() -> None:
    assert ask("truck and car").reason == "no 'truck' was found"
    assert ask("green car and tree").reason == "no 'car' of that kind was found"
    assert ask("truck").reason == ""  # the status says it


def test_who_looks_decides_left_and_right() -> None:
    here = np.array([5.0, -20.0, 1.7])
    assert ids("car to the left of the tree", here) == [1]
    assert ids("the nearest person", here) == [4]
    nobody = ask("car to the left of the tree")
    assert nobody.status is Status.APPROXIMATE
    assert "'left of' depends on who looks" in nobody.reason


def test_scores_rank_hits() -> None:
    objects = [
        Thing(1, {"car": 0.4}, scene()[0].box),
        Thing(2, {"car": 0.8, "truck": 0.1}, scene()[1].box),
        Thing(3, {"person": 0.9}, scene()[3].box),
    ]
    found = select(understand("car", Closed()), objects)
    assert [(hit.id, hit.score) for hit in found.hits] == [(2, 0.8), (1, 0.4)]


# --- geometry of boxes


def _dense_gap(one: Box, other: Box) -> float:
    """The slow twin of :func:`gap_above`: between points all over the two rectangles."""
    share = np.linspace(0, 1, 41)
    clouds = []
    for box in (one, other):
        a, b, _, d = box.corners()
        u, v = (grid.reshape(-1, 1) for grid in np.meshgrid(share, share))
        clouds.append(a + u * (b - a) + v * (d - a))
    return float(np.linalg.norm(clouds[0][:, None] - clouds[1][None], axis=2).min())


def test_gaps_of_turned_boxes() -> None:
    rng = np.random.default_rng(3)
    for _ in range(30):
        one, other = (
            Box(rng.uniform(-2, 2, 3), rng.uniform(0.2, 2, 3), rng.uniform(0, math.pi)) for _ in range(2)
        )
        assert gap_above(one, other) == pytest.approx(_dense_gap(one, other), abs=0.06)
        assert gap_above(one, other) == pytest.approx(gap_above(other, one))


def test_gap_counts_height_and_degenerate_boxes() -> None:
    low, high = Box(np.zeros(3), np.ones(3)), Box(np.array([0, 0, 3.0]), np.ones(3))
    assert gap(low, high) == pytest.approx(2.0)
    point = Box(np.array([3.0, 0, 0]), np.zeros(3))
    assert gap(low, point) == pytest.approx(2.5)
    assert gap(point, point) == 0.0
    assert between(point, point, point) == 0.0
    assert seen_from(point.centre, "behind", low, point) == 0.0


# --- without a network


def test_pieces_of_the_mesh_are_judged_by_size() -> None:
    backend = AttributeBackend()
    asked = understand("red car", backend)
    assert (asked.status, asked.classes[0]) == (Status.APPROXIMATE, "car")
    assert "size and shape only" in asked.reason
    assert understand("giraffe", backend).status is Status.UNSUPPORTED
    assert understand("vehicles", backend).status is Status.APPROXIMATE
    pieces = [Thing(item.id, shape_scores(item.box), item.box, item.colour) for item in scene()]
    assert [hit.id for hit in select(asked, pieces).hits] == [1]
    person = select(understand("person", backend), pieces)
    assert {hit.id for hit in person.hits} == {4, 5}
    assert person.status is Status.APPROXIMATE
    assert shape_scores(Box(np.zeros(3), np.zeros(3))) == {}
    found = backend.segment(np.zeros((4, 6, 3), np.uint8), [Prompt(1, "car"), Prompt(2, "giraffe")])
    assert [answer.status for answer in found.answers] == [Status.NOT_FOUND, Status.UNSUPPORTED]
    assert found.dense.sample(np.array([2.0]), np.array([1.0])).tolist() == [[1.0]]


# --- colours


@pytest.mark.parametrize(
    ("rgb", "word"),
    [
        ((200, 30, 30), "red"), ((120, 40, 38), "red"), ((235, 130, 30), "orange"), ((230, 210, 40), "yellow"),
        ((40, 140, 50), "green"), ((60, 80, 40), "green"), ((30, 60, 170), "blue"), ((90, 60, 35), "brown"),
        ((130, 50, 150), "purple"), ((240, 150, 180), "pink"), ((15, 15, 17), "black"), ((128, 130, 127), "grey"),
        ((245, 245, 240), "white"), ((40, 190, 190), "cyan"),
    ],
)  # fmt: skip
def test_colours_by_name(rgb: tuple[int, int, int], word: str) -> None:
    names = [
        "red",
        "orange",
        "yellow",
        "green",
        "blue",
        "brown",
        "purple",
        "pink",
        "black",
        "grey",
        "white",
        "cyan",
    ]
    fits = {name: colour_fit(rgb, name) for name in names}
    assert max(fits, key=lambda name: fits[name]) == word
    assert fits[word] >= 0.5
