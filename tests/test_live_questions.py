"""Questions of a live run: taken, looked for by the newest photograph, sent as masks, fused, answered, forgotten."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from artemis_edge import topics
from artemis_edge.block_store import CLASSES, LOG_CLASS, WEIGHT
from artemis_edge.config import SemanticsConfig
from artemis_edge.errors import InputError
from artemis_edge.forgetting import Forgotten, forget_logs, forget_sums
from artemis_edge.frames import U8, CameraImage, CameraModel, MeshDelta
from artemis_edge.lights import lit
from artemis_edge.paging import PageFile, pack
from artemis_edge.segmentation import attribute
from artemis_edge.segmentation.backend import DenseScores, Grid, Prompt, Segmentation, Status, Support
from artemis_edge.segmentation.manifest import Manifest
from artemis_edge.segmentation.query import each_once, tidied
from artemis_edge.semantic_map import SemanticMap
from artemis_edge.service.answers import MapAnswers
from artemis_edge.service.questions import LONGEST, MOST_QUESTIONS, Desk
from artemis_edge.service.segmenter import LiveSegmenter, SegmenterTask
from artemis_edge.session.asked import Asked
from artemis_edge.session.late_masks import LateMasks, unpack
from artemis_edge.session.late_masks import pack as pack_mask
from artemis_edge.session.line_channel import LineChannel
from artemis_edge.session.message_ring import MessageRing
from artemis_edge.session.messages import CompressedImage, Header, Mask
from artemis_edge.sight import new_sight
from artemis_edge.status import QueryStatus
from tests import networks
from tests.test_segmentation_worker import png
from tests.test_semantic_map import small_store
from tests.waiting import until

SECOND = 10**9
CAMERA = CameraModel(160, 120, 100.0, 100.0, 79.5, 59.5)
MODEL = Manifest(
    name="colours", kind="semantic", file="f", sha256="0" * 64, licence="ours",
    classes=("background", "car", "person", "bench", "tree"),
)  # fmt: skip
CAR = (Prompt(1, "car"),)


def asked(**slots: int) -> Asked:
    return Asked(MODEL, tuple(slots), {slot: name for name, slot in slots.items()})


def scores(*slots: int) -> DenseScores:
    rng = np.random.default_rng(len(slots))
    score = rng.integers(0, 256, (6, 8, len(slots) + 1), np.uint8)
    return DenseScores((0, *slots), score, Grid(0.05, 0.05, 0.5, 0.25))


def image(stamp_s: float, name: str = "cam") -> CameraImage:
    return CameraImage(name, int(stamp_s * SECOND), b"", CAMERA, np.eye(4))


# --- masks as messages


def test_a_mask_is_what_it_was_after_the_way() -> None:
    sent = pack_mask("cam", 5, (Prompt(3, "car"), Prompt(7, "bench")), scores(3, 7))
    found = Mask.decode(sent.encode())
    assert (found.header, found.text) == (Header(5, "cam"), ("", "car", "bench"))
    prompts, seen = unpack(found)
    assert prompts == (Prompt(3, "car"), Prompt(7, "bench"))
    assert seen.slots == (0, 3, 7) and seen.grid == scores(3, 7).grid
    np.testing.assert_array_equal(seen.score, scores(3, 7).score)


@pytest.mark.parametrize(
    "wrong",
    [
        {"slot": np.array([1, 0], np.uint8)},
        {"slot": np.array([0, 99], np.uint8)},
        {"slot": np.array([], np.uint8)},
        {"height": 7},
        {"width": 1 << 30},
        {"text": ("",)},
        {"grid": np.full(4, np.nan)},
        {"score": b"no zlib"},
    ],
)
def test_a_damaged_mask_is_counted(wrong: dict[str, object]) -> None:
    whole = pack_mask("cam", 5, CAR, scores(1))
    fields = {name: getattr(whole, name) for name in Mask.__dataclass_fields__ if name != "ROS_TYPE"}
    masks = LateMasks()
    masks.take(Mask(**{**fields, **wrong}))
    assert masks.lost == {"masks_undecodable": 1}


def test_masks_wait_for_the_frame_of_their_image_and_lose_what_is_forgotten() -> None:
    masks = LateMasks()
    masks.asked = asked(car=1, bench=2)
    masks.take(pack_mask("cam", SECOND, (*CAR, Prompt(2, "bench")), scores(1, 2)))
    assert masks.ready() == []
    masks.offer(image(1.0), lambda: new_sight(CAMERA, np.eye(4)))
    masks.asked = asked(bench=2, tree=1)  # the slot of the car is another's
    (mask,) = masks.ready()
    assert mask.scores.slots == (0, 2) and mask.sight.depth.shape == new_sight(CAMERA, np.eye(4)).depth.shape
    masks.take(pack_mask("cam", SECOND, CAR, scores(1)))
    assert masks.ready() == [] and masks.lost == {}
    masks.take(pack_mask("cam", 7, (Prompt(1, "tree"),), scores(1)))
    for _ in range(40):
        masks.ready()
    assert masks.lost == {"masks_without_frame": 1} and masks.fused == 1


def test_no_frame_fuses_more_than_a_few() -> None:
    masks = LateMasks()
    masks.asked = asked(car=1)
    masks.offer(image(1.0), lambda: new_sight(CAMERA, np.eye(4)))
    for _ in range(5):
        masks.take(pack_mask("cam", SECOND, CAR, scores(1)))
    assert [len(masks.ready()) for _ in range(4)] == [2, 2, 1, 0]
    for _ in range(5):
        masks.take(pack_mask("cam", SECOND, CAR, scores(1)))
    assert len(masks.drain()) == 5 and masks.fused == 10


def test_of_old_images_the_view_is_kept_without_its_depth() -> None:
    masks = LateMasks()
    masks.asked = asked(car=1)
    for k in range(60):
        masks.offer(image(k), lambda: new_sight(CAMERA, np.eye(4)))
    masks.take(pack_mask("cam", 3 * SECOND, CAR, scores(1)))
    (mask,) = masks.ready()
    assert mask.sight.depth.size == 0


# --- forgetting


def naive_forget(row: np.ndarray, gone: U8, active: U8, join: object) -> np.ndarray:
    out = row.astype(np.float64).copy()
    out[0] = join([row[0], *(row[c] for c in range(1, CLASSES) if gone[c])])  # type: ignore[operator]
    for c in range(1, CLASSES):
        if gone[c] or not active[c]:
            out[c] = out[0]
    return out


def test_what_is_forgotten_becomes_background() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        gone, active = rng.integers(0, 2, (2, CLASSES)).astype(np.uint8)
        sums, logs = (
            rng.uniform(0, 5, CLASSES + 1).astype(np.float32),
            np.zeros(LOG_CLASS + CLASSES, np.float32),
        )
        logs[LOG_CLASS:] = rng.uniform(-20, 0, CLASSES)
        expected = (
            naive_forget(sums[:CLASSES], gone, active, sum),
            naive_forget(logs[LOG_CLASS:], gone, active, max),
        )
        weight = sums[WEIGHT]
        forget_sums(sums, gone, active)
        forget_logs(logs, gone, active)
        np.testing.assert_allclose(sums[:CLASSES], expected[0], rtol=1e-5)
        np.testing.assert_allclose(logs[LOG_CLASS:], expected[1], rtol=1e-6)
        assert sums[WEIGHT] == weight
    blank = np.zeros(LOG_CLASS + CLASSES, np.float32)
    forget_logs(blank, np.ones(CLASSES, np.uint8), np.zeros(CLASSES, np.uint8))
    assert not blank.any()


def test_a_slot_that_is_given_to_another_class_begins_anew_in_memory_and_on_disk(tmp_path: Path) -> None:
    store = small_store()
    store.attribute[0, LOG_CLASS:] = -9.0
    store.attribute[0, LOG_CLASS + 1] = 0.0  # surely slot 1
    store.voxel_class[0, [1, WEIGHT]] = 4.0
    semantics = SemanticMap(SemanticsConfig(), store, 0.4)
    assert semantics.assign({1: "car", 2: "bench"}, 1) is None and semantics.asked
    file = PageFile(tmp_path)
    file.put(5, pack(store, np.zeros(1, np.int32)))
    forgotten = semantics.assign({1: "tree", 2: "bench"}, 2)
    assert forgotten is not None
    file.mend.append(forgotten)
    assert semantics.names == {0: "background", 1: "tree", 2: "bench"}
    assert semantics.active.tolist() == [1, 1, 1] + [0] * 13
    page = file.take(5)
    file.close()
    for attribute_row, sums in (
        (store.attribute[0], store.voxel_class[0]),
        (page.attribute[0], page.voxel_class[0]),
    ):
        assert attribute_row[LOG_CLASS] == attribute_row[LOG_CLASS + 1] == 0.0
        assert attribute_row[LOG_CLASS + 2] == -9.0
        assert sums[0] == sums[1] == sums[WEIGHT] == 4.0 and sums[2] == 0.0
    assert semantics.assign({2: "bench"}, 3) is not None
    assert semantics.assign({2: "bench"}, 4) is None


def test_pages_need_only_what_was_forgotten_after_them(tmp_path: Path) -> None:
    store, file = small_store(), PageFile(tmp_path)
    counted: list[int] = []
    file.put(1, pack(store, np.zeros(1, np.int32)))
    file.mend.append(lambda page: counted.append(1) or page)  # type: ignore[func-returns-value]
    file.put(2, pack(store, np.zeros(1, np.int32)))
    file.get(2)
    assert counted == []
    file.get(1)
    assert counted == [1]
    file.close()
    assert isinstance(Forgotten(np.zeros(1, np.uint8), np.zeros(1, np.uint8)).gone, np.ndarray)


# --- the desk


def test_questions_take_slots_and_give_them_back() -> None:
    desk = Desk(MODEL)
    car, red, next_to = (desk.ask(text) for text in ("car", "red  car", "person next to the bench"))
    assert (car.status, car.labels, red.labels, next_to.labels) == ("searching", [1], [], [])
    assert len({car.colour, red.colour, next_to.colour}) == 3
    assert desk.ask("giraffe").status == "unsupported" and desk.ask(" car ") == car
    assert desk.asked().texts == ("car", "red car", "person next to the bench", "giraffe")
    assert desk.asked().slots == {1: "car", 2: "person", 3: "bench"}
    desk.forget("car")
    assert desk.asked().slots[1] == "car", "the red one is looked for still"
    desk.forget("red car")
    assert desk.asked().slots == {2: "person", 3: "bench"}
    with pytest.raises(InputError, match="not among the questions asked"):
        desk.forget("car")
    assert Asked.decode(__import__("json").dumps(desk.asked().plain())) == desk.asked()


@pytest.mark.parametrize("text", ["", "   ", None, 5, ["car"], "car " * LONGEST, "a \ud800 tree"])
def test_what_is_no_question_is_refused_with_a_sentence(text: object) -> None:
    with pytest.raises(InputError, match=r"write what to look for|at most 500|half a character"):
        Desk(MODEL).ask(text)


def test_a_question_is_the_same_whatever_its_case_and_invisible_characters() -> None:
    desk = Desk(MODEL)
    desk.ask("Red\x1b \tCar\x00")
    assert desk.asked().texts == ("Red Car",)
    assert desk.ask("\u202ered  car\u202c").text == "Red Car"
    assert desk.asked().texts == ("Red Car",)
    desk.forget("RED CAR\n")
    assert desk.asked().texts == ()
    assert each_once(["car", "Car\r", " bench", ""]) == ("car", "bench", "")
    assert tidied("\U0001f469\u200d\U0001f680") == "\U0001f469\u200d\U0001f680"


def test_there_is_an_end_to_questions() -> None:
    desk = Desk(MODEL)
    for k in range(MOST_QUESTIONS):
        assert desk.ask(f"giraffe {'o' * k}").status == "unsupported"
    with pytest.raises(InputError, match="32 questions are asked already"):
        desk.ask("car")


def test_what_the_map_answers_is_told() -> None:
    desk = Desk(MODEL)
    desk.ask("car")
    desk.ask("red car")
    answer = {"status": "approximate", "note": "", "count": 1, "score": 0.9, "places": [[1, 2, 3]]}
    box = [1.0, 2.0, 3.0, 2.0, 1.0, 1.0, 0.0]
    said = {"answers": [{"text": "red car", "boxes": [box], **answer}], "looking_back": [2, 9]}
    assert [query.status for query in desk.told(None)] == ["waiting", "waiting"]
    car, red = desk.told(said)
    assert (car.status, car.labels, car.boxes, car.note) == ("searching", [1], [], "looking back: 2 of 9")
    assert (red.status, red.count, red.score, red.labels, red.boxes) == ("approximate", 1, 0.9, [1], [box])
    assert red.places == [(1, 2, 3)]


def test_of_the_cars_only_the_red_one_lights_up() -> None:
    points = np.array([[0, 0, 0], [5, 0, 0], [5, 0.9, 0], [5, 3.0, 0]], np.float32)
    label = np.array([1, 1, 1, 2], np.uint8)
    turned = [5.0, 0.0, 0.0, 0.5, 2.0, 1.0, 0.0]
    queries = [
        QueryStatus("red car", labels=[1], boxes=[turned], colour=(9, 9, 9)),
        QueryStatus("bench", labels=[2], colour=(1, 1, 1)),
        QueryStatus("nothing", labels=[3]),
    ]
    found = [(rows.tolist(), colour) for rows, colour in lit(points, label, queries)]
    assert found == [
        ([False, True, True, False], (9, 9, 9)),
        ([False, False, False, True], (1, 1, 1)),
    ]
    quarter = [*turned[:6], np.pi / 2]
    (rows,) = [rows for rows, _ in lit(points, label, [QueryStatus("red car", labels=[1], boxes=[quarter])])]
    assert rows.tolist() == [False, True, False, False]


# --- the network's process


class Painter:
    """A backend that remembers what it was asked and sees everything everywhere."""

    name, classes = "painter", ("car", "bench", "tree")

    def __init__(self) -> None:
        self.asked: list[tuple[str, ...]] = []

    def support(self, text: str) -> Support:
        return Support(Status.MATCHED)

    def segment(self, image: U8, prompts: Sequence[Prompt]) -> Segmentation:
        self.asked.append(tuple(prompt.text for prompt in prompts))
        slots = tuple(prompt.slot for prompt in prompts)
        return Segmentation(image.shape[1], image.shape[0], (), (), scores(*slots))


class Bench:
    """A segmenter with a ring to fill and the service's end of its channel."""

    def __init__(self, first: Asked, most_hz: float = 0.0) -> None:
        ours, theirs = socket.socketpair()
        self.channel, self.painter = LineChannel(ours), Painter()
        self.ring = MessageRing.create(4.0)
        task = SegmenterTask((topics.CAMERA_IMAGE.name,), first, 0.25, 0.7, most_hz)
        self.segmenter = LiveSegmenter(task, self.ring, LineChannel(theirs), self.painter)
        self.photograph = png(networks.photograph())

    def publish(self, stamp_s: float) -> None:
        message = CompressedImage(Header(round(stamp_s * SECOND), "cam"), "png", self.photograph)
        self.ring.publish(topics.CAMERA_IMAGE.name, message.ROS_TYPE, 0, 0, message.encode())

    def masks(self) -> list[float]:
        import base64

        found = [line["mask"] for line in self.channel.lines() if "mask" in line]
        return [Mask.decode(base64.b64decode(text)).header.stamp_ns / SECOND for text in found]

    def close(self) -> None:
        self.channel.socket.close()
        self.segmenter.channel.socket.close()
        self.ring.close()


def test_the_newest_photograph_wins() -> None:
    bench = Bench(asked(car=1))
    assert not bench.segmenter.turn()
    for k in range(5):
        bench.publish(k / 10)
    assert bench.segmenter.turn() and not bench.segmenter.turn()
    assert bench.masks() == [0.4]
    bench.ring.publish(topics.CAMERA_IMAGE.name, CompressedImage.ROS_TYPE, 0, 0, b"damaged")
    assert not bench.segmenter.turn()
    bench.close()


def test_a_new_question_is_looked_for_in_old_photographs_too() -> None:
    bench = Bench(asked(car=1))
    for k in range(8):  # one a second is kept: at 0.0, 1.0, 2.0, 3.0
        bench.publish(k / 2)
        bench.segmenter.turn()
    bench.masks()
    bench.channel.say({"do": "asked", "asked": asked(car=1, bench=2).plain()})
    assert until(lambda: not bench.segmenter.turn() and not bench.segmenter.looking_back)
    assert bench.masks() == [3.0, 2.0, 1.0, 0.0]
    assert bench.painter.asked[-4:] == [("bench",)] * 4, "cars were looked for there already"
    bench.segmenter.ask(asked(car=1, bench=2, tree=3))
    bench.segmenter.ask(asked(car=1, bench=2))
    assert not bench.segmenter.turn(), "nobody asks for trees any more"
    bench.close()


def test_the_rate_is_bounded_and_nothing_is_done_without_questions() -> None:
    bench = Bench(asked(car=1))
    bench.channel.say({"do": "rate", "hz": 2.0})
    for k in range(10):
        bench.publish(k / 10)
        bench.segmenter.turn()
    assert bench.masks() == [0.0, 0.5]
    bench.segmenter.ask(asked())
    bench.publish(9.0)
    assert not bench.segmenter.turn()
    assert bench.segmenter.status()["segmented"] == 2
    bench.channel.say({"do": "stop"})
    bench.segmenter.run()
    bench.close()


# --- what the mesh answers


class News:
    def __init__(self, *deltas: MeshDelta) -> None:
        self.deltas = list(deltas)

    def take(self) -> list[MeshDelta]:
        news, self.deltas = self.deltas, []
        return news


def wall(block: int, x: float, label: int, probability: int, colour: tuple[int, int, int]) -> MeshDelta:
    """A square metre of surface across the line of sight, at ``x``."""
    y, z = np.meshgrid(np.arange(0, 1.01, 0.1), np.arange(0, 1.01, 0.1))
    n = y.size
    rows = np.arange(n).reshape(11, 11)
    a, b, c, d = (part.ravel() for part in (rows[:-1, :-1], rows[:-1, 1:], rows[1:, :-1], rows[1:, 1:]))
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)]) + 1000 * block
    return MeshDelta(
        index=0,
        block=np.array([[block, 0, 0]], np.int32),
        vertex_start=np.array([0, n]),
        triangle_start=np.array([0, len(triangles)]),
        vertex_id=np.arange(n) + 1000 * block,
        position=np.stack([np.full(n, x), y.ravel(), z.ravel()], 1).astype(np.float32),
        normal=np.zeros((n, 3), np.float32),
        colour=np.tile(np.array(colour, np.uint8), (n, 1)),
        label=np.full(n, label, np.uint8),
        confidence=np.ones(n, np.float32),
        triangles=triangles.astype(np.int64),
        probability=np.full(n, probability, np.uint8),
    )


def test_the_growing_mesh_answers() -> None:
    red, blue = (220, 20, 20), (20, 20, 220)
    source = News(
        wall(0, 0.0, 1, 230, red),
        wall(1, 4.0, 1, 200, blue),
        wall(2, 8.0, 1, 60, red),
        wall(3, 12, 2, 255, red),
    )
    answers = MapAnswers(source)
    question = Asked(MODEL, ("car", "red car", "bench", "giraffe"), {1: "car", 3: "bench"})
    car, red_car, bench, giraffe = answers.told(question)
    assert (car["count"], car["status"]) == (2, "matched"), "of the third one the map is not sure"
    assert car["score"] == pytest.approx(230 / 255, abs=1e-3)
    assert (red_car["count"], red_car["status"], red_car["places"]) == (1, "approximate", [[0.0, 0.5, 0.5]])
    assert red_car["boxes"][0][:3] == [0.0, 0.5, 0.5] and len(red_car["boxes"][0]) == 7
    assert (bench["count"], giraffe["count"], giraffe["status"]) == (0, 0, "unsupported")
    assert answers.told(Asked(attribute.manifest())) == []
    source.deltas = [wall(0, 0.0, 0, 0, red), wall(1, 4.0, 0, 0, red)]
    assert [answer["count"] for answer in answers.told(question)] == [0, 0, 0, 0]
