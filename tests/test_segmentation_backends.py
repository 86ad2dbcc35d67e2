"""Every kind of backend at work on networks of its signature, and on real ones where they are there."""

import os
from collections.abc import Callable
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from artemis_edge.errors import InputError
from artemis_edge.segmentation.backend import Backend, Prompt, Segmentation, Status
from artemis_edge.segmentation.clip import EmbeddingTable, TextEncoder, phrase
from artemis_edge.segmentation.clip_tokens import Tokenizer
from artemis_edge.segmentation.manifest import Kind, Manifest, Part
from artemis_edge.segmentation.network import Network
from artemis_edge.segmentation.opening import open_model
from tests import networks

PROMPTS = (Prompt(4, "car"), Prompt(2, "bench"), Prompt(7, "giraffe"))


def manifest(kind: Kind, parts: dict[str, Path] | None = None, **more: object) -> Manifest:
    found = {role: Part(file=path.name, sha256="0" * 64) for role, path in (parts or {}).items()}
    return Manifest(
        name="colours",
        kind=kind,
        file="model.onnx",
        sha256="0" * 64,
        licence="ours",
        parts=found,
        **more,  # type: ignore[arg-type]
    )


def yolo_export(folder: Path) -> Backend:
    networks.yolo_export(folder / "model.onnx")
    return open_model(manifest("yolo-seg", classes=networks.CLASSES), folder)


def yolo_raw(folder: Path) -> Backend:
    networks.yolo_raw(folder / "model.onnx")
    return open_model(manifest("yolo-seg", classes=networks.CLASSES, input_size=(128, 160)), folder)


def semantic(folder: Path) -> Backend:
    networks.semantic(folder / "model.onnx")
    classes = ("background", *networks.CLASSES)
    return open_model(manifest("semantic", classes=classes, input_size=(120, 160), stride=8), folder)


def test_large_images_are_read_at_the_fine_size_too_where_nobody_waits(tmp_path: Path) -> None:
    networks.semantic(tmp_path / "model.onnx")
    classes, stride = ("background", *networks.CLASSES), 8
    coarse, fine = (
        open_model(manifest("semantic", classes=classes, input_size=size, stride=stride), tmp_path)
        for size in ((56, 72), (88, 120))
    )
    said = manifest(
        "semantic", classes=classes, input_size=(56, 72), fine_input_size=(88, 120), stride=stride
    )
    live, both = open_model(said, tmp_path), open_model(said, tmp_path, fine=True)
    image, prompts = networks.photograph(), (Prompt(1, "car"), Prompt(2, "person"))
    one, two = coarse.segment(image, prompts).dense, fine.segment(image, prompts).dense
    found = both.segment(image, prompts)
    np.testing.assert_array_equal(live.segment(image, prompts).dense.score, one.score)
    assert (found.dense.grid, found.dense.score.shape) == (two.grid, two.score.shape)
    row, column = np.mgrid[0 : two.score.shape[0], 0 : two.score.shape[1]].reshape(2, -1)
    u, v = (column - two.grid.offset_x) / two.grid.scale_x, (row - two.grid.offset_y) / two.grid.scale_y
    wanted = (one.sample(u, v) + two.sample(u, v)) / 2
    assert np.abs(one.sample(u, v) - two.sample(u, v)).max() > 0.2  # at rims they differ
    np.testing.assert_allclose(found.dense.sample(u, v), wanted, atol=0.012)
    assert [answer.status for answer in found.answers] == [Status.MATCHED] * 2
    small = np.ascontiguousarray(image[:80, :112])  # enlarged it would tell nothing new
    np.testing.assert_array_equal(
        both.segment(small, prompts).dense.score, coarse.segment(small, prompts).dense.score
    )


def test_boxes_are_looked_for_at_the_fine_size_alone(tmp_path: Path) -> None:
    networks.yolo_raw(tmp_path / "model.onnx")
    said = manifest("yolo-seg", classes=networks.CLASSES, input_size=(64, 96), fine_input_size=(128, 160))
    fine = yolo_raw(tmp_path).segment(networks.photograph(), PROMPTS)
    found = open_model(said, tmp_path, fine=True).segment(networks.photograph(), PROMPTS)
    np.testing.assert_array_equal(found.dense.score, fine.dense.score)
    assert open_model(said, tmp_path).segment(networks.photograph(), PROMPTS).dense.score.shape[:2] == (
        16,
        24,
    )


def test_what_a_class_owes_to_its_frequency_is_taken_out_of_the_map_s_scores(tmp_path: Path) -> None:
    networks.semantic(tmp_path / "model.onnx")
    said = manifest("semantic", classes=("background", *networks.CLASSES), input_size=(120, 160), stride=8)
    shares = (0.6, 0.3, 0.0, 0.1)  # background, car, person, bench
    image = np.tile(np.array([0, 0, 120], np.uint8), (120, 160, 1))  # a little too dark for a bench
    prompts = (Prompt(1, "bench"), Prompt(2, "person"), Prompt(3, "bench"))
    plain = open_model(said, tmp_path).segment(image, prompts)
    even = open_model(msgspec.structs.replace(said, shares=shares), tmp_path).segment(image, prompts)
    assert even.dense.slots == plain.dense.slots == (0, 1, 2, 3)
    # bench, person, bench; cars are unasked for and background with it, and there are none here
    p = plain.dense.score[15, 20] / 255.0
    background = 0.9**0.75 / (0.6**0.75 + 0.3**0.75) * 0.6**-0.25
    weighted = p * [background, 0.1**-0.25, 0.001**-0.25, 0.1**-0.25]
    wanted = weighted / weighted[:3].sum()
    np.testing.assert_allclose(even.dense.score[15, 20] / 255.0, wanted, atol=0.012)
    assert even.dense.score[15, 20, 1] > plain.dense.score[15, 20, 1]
    assert [(a.status, a.score) for a in even.answers] == [(a.status, a.score) for a in plain.answers]
    with pytest.raises(InputError, match="shares"):
        open_model(msgspec.structs.replace(said, shares=shares[:3]), tmp_path)


def semantic_fixed(folder: Path) -> Backend:
    networks.semantic(folder / "model.onnx", (96, 192))
    return open_model(manifest("semantic", classes=("background", *networks.CLASSES)), folder)


def openvocab(folder: Path) -> Backend:
    networks.yolo_export(folder / "model.onnx", texts=True)
    np.save(folder / "table.npy", networks.RGB)
    parts = {"embeddings": folder / "table.npy"}
    return open_model(manifest("openvocab-seg", parts, classes=networks.CLASSES), folder)


def fastsam(folder: Path, batch: int | None = None) -> Backend:
    networks.yolo_export(folder / "model.onnx", classes=1)
    ids = networks.vocabulary(folder / "words.txt")
    # what the image encoder sees of red on white is white less green and blue
    vectors = {ids["car"]: np.array([1.0, -1.0, -1.0]), ids["person"]: np.array([-1.0, 1.0, -1.0])}
    networks.image_encoder(folder / "image.onnx", batch)
    networks.text_encoder(folder / "text.onnx", vectors, batch)
    parts = {"image": folder / "image.onnx", "text": folder / "text.onnx", "vocabulary": folder / "words.txt"}
    return open_model(manifest("fastsam-clip", parts), folder)


MAKERS: list[Callable[[Path], Backend]] = [
    yolo_export,
    yolo_raw,
    semantic,
    semantic_fixed,
    openvocab,
    fastsam,
]
CLOSED = MAKERS[:5]


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    return float((one & other).sum() / (one | other).sum())


def truth(cut: tuple[slice, slice]) -> np.ndarray:
    mask = np.zeros((120, 160), bool)
    mask[cut] = True
    return mask


@pytest.mark.parametrize("make", MAKERS)
def test_the_red_square_is_the_car(make: Callable[[Path], Backend], tmp_path: Path) -> None:
    found = make(tmp_path).segment(networks.photograph(), [Prompt(4, "car")])
    (answer,) = found.answers
    assert (answer.status, answer.score > 0.7) == (Status.MATCHED, True)
    score = found.dense.layer(4, 160, 120) / 255
    assert overlap(score > 0.5, truth(networks.RED)) > 0.8
    assert score[networks.GREEN].max() < 0.05
    assert {(item.slot, item.text) for item in found.instances} == {(4, "car")}
    masks = [item.image_mask(160, 120) > 0.5 for item in found.instances]
    assert max(overlap(mask, truth(networks.RED)) for mask in masks) > 0.6
    assert all((mask & ~truth(networks.RED)).mean() < 0.02 for mask in masks)
    for x0, y0, x1, y1 in (item.box for item in found.instances):
        assert 0 <= x0 < x1 <= 90
        assert 0 <= y0 < y1 <= 110


@pytest.mark.parametrize("make", CLOSED)
def test_absent_and_unknown_are_told_apart(make: Callable[[Path], Backend], tmp_path: Path) -> None:
    found = make(tmp_path).segment(networks.photograph(), PROMPTS)
    assert [answer.status for answer in found.answers] == [
        Status.MATCHED,
        Status.NOT_FOUND,
        Status.UNSUPPORTED,
    ]
    assert found.answers[1].score == 0.0
    assert "'giraffe'" in found.answers[2].reason
    slots = set(found.dense.slots)
    assert slots >= {0, 4, 2}
    assert found.dense.layer(2, 160, 120).max() < 26
    # background is what no layer claims
    background = found.dense.layer(0, 160, 120) / 255
    assert background[networks.GREEN].mean() > 0.9
    assert background[networks.RED].mean() < 0.3


def test_nobody_fits_better_than_the_decoys(tmp_path: Path) -> None:
    backend = fastsam(tmp_path)
    found = backend.segment(networks.photograph(), [Prompt(1, "person"), Prompt(3, "tree")])
    assert [answer.status for answer in found.answers] == [Status.MATCHED, Status.NOT_FOUND]
    assert overlap(found.dense.layer(1, 160, 120) > 127, truth(networks.GREEN)) > 0.8
    nothing = backend.segment(np.zeros((120, 160, 3), np.uint8), [Prompt(1, "person")])
    assert nothing.answers[0].status is Status.NOT_FOUND
    assert nothing.instances == ()


def test_encoders_of_one_image_at_a_time(tmp_path: Path) -> None:
    """Networks whose batch is fixed to one give the same."""
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    both = [fastsam(tmp_path / name, batch) for name, batch in (("a", None), ("b", 1))]
    one, two = (backend.segment(networks.photograph(), [Prompt(1, "car")]) for backend in both)
    np.testing.assert_array_equal(one.dense.score, two.dense.score)


@pytest.mark.parametrize("make", MAKERS)
def test_no_prompts_and_tiny_images(make: Callable[[Path], Backend], tmp_path: Path) -> None:
    backend = make(tmp_path)
    nothing = backend.segment(networks.photograph(), [])
    assert (nothing.answers, nothing.instances, nothing.dense.slots) == ((), (), (0,))
    assert nothing.dense.score.min() == 255
    tiny = backend.segment(np.full((1, 3, 3), 200, np.uint8), [Prompt(1, "car")])
    assert (tiny.width, tiny.height, len(tiny.answers)) == (3, 1, 1)


@pytest.mark.parametrize("make", MAKERS)
def test_the_same_image_gives_the_same_bytes(make: Callable[[Path], Backend], tmp_path: Path) -> None:
    backend = make(tmp_path)
    one, two = (backend.segment(networks.photograph(), [Prompt(1, "car")]) for _ in range(2))
    assert one.dense.score.tobytes() == two.dense.score.tobytes()
    assert [item.probability for item in one.instances] == [item.probability for item in two.instances]


def test_two_slots_may_claim_a_cell(tmp_path: Path) -> None:
    """An instance of two classes keeps both probabilities: nothing is normalised over them."""
    networks.yolo_export(tmp_path / "model.onnx")
    backend = open_model(manifest("yolo-seg", classes=("car", "automobile", "truck")), tmp_path)
    assert backend.support("car").status is Status.MATCHED
    assert backend.support("automobile").status is Status.UNSUPPORTED  # asked for by its canonical name


def test_a_table_needs_a_row_for_each_class(tmp_path: Path) -> None:
    np.save(tmp_path / "t.npy", np.ones((2, 3)))
    with pytest.raises(InputError, match="need a row each"):
        EmbeddingTable(tmp_path / "t.npy", networks.CLASSES)
    (tmp_path / "t.npy").write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"give an \.npy file"):
        EmbeddingTable(tmp_path / "t.npy", networks.CLASSES)


def test_vectors_of_another_length_are_refused(tmp_path: Path) -> None:
    networks.yolo_export(tmp_path / "model.onnx", texts=True)
    np.save(tmp_path / "table.npy", np.ones((3, 5)))
    said = manifest("openvocab-seg", {"embeddings": tmp_path / "table.npy"}, classes=networks.CLASSES)
    backend = open_model(said, tmp_path)
    with pytest.raises(InputError, match="takes vectors of 3 numbers, those of the text have 5"):
        backend.segment(networks.photograph(), [Prompt(1, "car")])


# --- tokens


def test_tokens_of_a_small_vocabulary(tmp_path: Path) -> None:
    ids = networks.vocabulary(tmp_path / "words.txt")
    row = Tokenizer(tmp_path / "words.txt").encode(["A  CAR &amp; tree"])[0]
    assert row[0] == 49406
    assert ids["car"] in row
    assert ids["tree"] in row
    assert row[5] == 49407
    assert (len(row), row[6:].tolist()) == (77, [0] * 71)


def test_long_texts_and_odd_signs(tmp_path: Path) -> None:
    networks.vocabulary(tmp_path / "words.txt")
    rows = Tokenizer(tmp_path / "words.txt").encode(["car " * 200, "", "🚗 it's 42 naïve\n"])
    assert rows.shape == (3, 77)
    assert rows[0, -1] == 49407
    assert rows[1, :3].tolist() == [49406, 49407, 0]
    assert rows.max() == 49407


@pytest.mark.parametrize("content", [b"", b"one\n", b"\x1f\x8bxx", b"\xff\xfe"])
def test_what_is_no_vocabulary(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "words.txt").write_bytes(content)
    with pytest.raises(InputError, match=r"words\.txt"):
        Tokenizer(tmp_path / "words.txt")


def test_a_text_encoder_is_told_from_others(tmp_path: Path) -> None:
    networks.vocabulary(tmp_path / "words.txt")
    network = Network(networks.semantic(tmp_path / "n.onnx"))
    with pytest.raises(InputError, match="is not a text encoder"):
        TextEncoder(network, Tokenizer(tmp_path / "words.txt"))
    assert phrase("orange") == "a photo of an orange"


# --- real networks


def real(name: str) -> Path:
    folder = os.environ.get("ARTEMIS_MODELS")
    if not folder or not (Path(folder) / name).is_file():
        pytest.skip("needs the network files (ARTEMIS_MODELS)")
    return Path(folder) / name


@pytest.mark.models
def test_tokens_of_clip_itself() -> None:
    """Ids as published with CLIP's examples."""
    rows = Tokenizer(real("bpe_simple_vocab_16e6.txt.gz")).encode(["a photo of a cat", "hello world!"])
    assert rows[0, :8].tolist() == [49406, 320, 1125, 539, 320, 2368, 49407, 0]
    assert rows[1, :5].tolist() == [49406, 3306, 1002, 256, 49407]


@pytest.mark.models
def test_vectors_of_real_words() -> None:
    from artemis_edge.segmentation.opening import names_in

    names = names_in(Network(real("yolov8n-seg_rawheads_static-int8_448.onnx")))
    table = EmbeddingTable(real("coco_clip_text_embeddings.npy"), names)
    car, truck, banana = table.features(["car", "truck", "banana"])
    assert float(car @ car) == pytest.approx(1.0, abs=1e-3)
    assert float(car @ truck) > float(car @ banana) + 0.05
    assert table.knows("motorcycle") and not table.knows("zorblax")


@pytest.mark.models
@pytest.mark.data
@pytest.mark.parametrize(
    "name",
    ["yolov8n-seg_dynamic-int8_320.onnx", "yolov8n-seg_rawheads_fp32_anysize.onnx",
     "yolov8n-seg_rawheads_static-int8_448.onnx"],
)  # fmt: skip
def test_people_in_a_photograph(name: str) -> None:
    from artemis_edge.segmentation.opening import names_in

    data = os.environ.get("ARTEMIS_DATA")
    if not data:
        pytest.skip("needs real recordings (ARTEMIS_DATA)")
    path = real(name)
    (photograph,) = Path(data).glob("coco_panoptic_1/input_images/*.jpg")
    said = manifest("yolo-seg", classes=names_in(Network(path)), input_size=(448, 448))
    backend = open_model(
        Manifest(**{**{f: getattr(said, f) for f in said.__struct_fields__}, "file": path.name}), path.parent
    )
    image = cv2.cvtColor(cv2.imread(str(photograph)), cv2.COLOR_BGR2RGB)
    found: Segmentation = backend.segment(image, [Prompt(1, "person"), Prompt(2, "giraffe")])
    assert [answer.status for answer in found.answers] == [Status.MATCHED, Status.NOT_FOUND]
    assert len(found.instances) >= 5
