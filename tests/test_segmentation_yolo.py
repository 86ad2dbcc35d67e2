"""Letterbox, decoding of both tensor layouts, suppression and masks, against slow twins."""

import numpy as np
import pytest

from artemis_edge.errors import InputError
from artemis_edge.segmentation import yolo
from artemis_edge.segmentation.backend import DenseScores, Grid
from artemis_edge.segmentation.letterbox import Letterbox


def expected_box(distribution: np.ndarray, x: int, y: int, stride: int) -> list[float]:
    """Slow twin of the decoding of one anchor; ``distribution`` (4, 16) logits."""
    edges = []
    for row in distribution:
        weights = [np.exp(v) for v in row]
        edges.append(sum(k * w for k, w in enumerate(weights)) / sum(weights))
    left, top, right, bottom = edges
    return [
        (x + 0.5 - left) * stride,
        (y + 0.5 - top) * stride,
        (x + 0.5 + right) * stride,
        (y + 0.5 + bottom) * stride,
    ]


def heads(rng: np.random.Generator, classes: int = 5) -> dict[str, np.ndarray]:
    """Raw heads of a random 64 x 96 input; about one logit in twenty is above 0."""
    outputs = {}
    for stride in (8, 16, 32):
        cells = (64 // stride, 96 // stride)
        outputs[f"box{stride}"] = rng.normal(0, 2, (1, 64, *cells)).astype(np.float32)
        outputs[f"cls{stride}"] = rng.normal(-3.3, 2, (1, classes, *cells)).astype(np.float32)
        outputs[f"coef{stride}"] = rng.normal(0, 1, (1, 32, *cells)).astype(np.float32)
    outputs["proto"] = rng.normal(0, 1, (1, 32, 16, 24)).astype(np.float32)
    return outputs


def slow_candidates(
    outputs: dict[str, np.ndarray], wanted: list[int], least: float
) -> list[tuple[float, ...]]:
    rows = []
    for stride in (8, 16, 32):
        _, _, high, wide = outputs[f"cls{stride}"].shape
        for column, name in enumerate(wanted):
            for y in range(high):
                for x in range(wide):
                    score = 1 / (1 + np.exp(-float(outputs[f"cls{stride}"][0, name, y, x])))
                    if score >= least:
                        box = expected_box(outputs[f"box{stride}"][0, :, y, x].reshape(4, 16), x, y, stride)
                        rows.append((column, score, *box, *outputs[f"coef{stride}"][0, :, y, x]))
    return sorted(rows)


def as_rows(found: yolo.Candidates) -> np.ndarray:
    rows = np.column_stack([found.column, found.score, found.box, found.coefficients])
    return rows[np.lexsort(rows.T[[1, 0]])]


def test_raw_heads_against_the_slow_twin() -> None:
    outputs = heads(np.random.default_rng(1))
    found, protos = yolo.candidates(outputs, [3, 0], 0.5)
    assert len(found.score) > 5
    np.testing.assert_allclose(as_rows(found), np.array(slow_candidates(outputs, [3, 0], 0.5)), atol=2e-4)
    assert protos.shape == (32, 16, 24)


def test_nothing_above_the_threshold() -> None:
    outputs = {key: np.full_like(value, -20.0) for key, value in heads(np.random.default_rng(1)).items()}
    for wanted in ([0, 1], []):
        found, _ = yolo.candidates(outputs, wanted, 0.5)
        assert (found.box.shape, found.coefficients.shape) == ((0, 4), (0, 32))
        assert len(yolo.suppress(found, 0.5, 10).score) == 0


def test_both_layouts_say_the_same() -> None:
    """The ordinary export holds what a host computes of raw heads."""
    outputs = heads(np.random.default_rng(2))
    everything, protos = yolo.candidates(outputs, [0, 1, 2, 3, 4], 1e-9)
    assert len(everything.score) == 5 * (8 * 12 + 4 * 6 + 2 * 3)
    per_class = [everything.take(np.flatnonzero(everything.column == k)) for k in range(5)]
    first = per_class[0].box
    centre, size = (first[:, :2] + first[:, 2:]) / 2, first[:, 2:] - first[:, :2]
    scores = np.stack([found.score for found in per_class])
    rows = np.concatenate([centre.T, size.T, scores, per_class[0].coefficients.T])[None]
    ordinary = {"output0": rows.astype(np.float32), "output1": protos[None]}
    one, _ = yolo.candidates(outputs, [4, 1], 0.3)
    two, _ = yolo.candidates(ordinary, [4, 1], 0.3)
    np.testing.assert_allclose(as_rows(one), as_rows(two), atol=1e-3)


def test_tensors_of_another_number_of_classes_are_refused() -> None:
    outputs = heads(np.random.default_rng(2), classes=5)
    yolo.check_classes(outputs, 5, "n")
    with pytest.raises(InputError, match="the model n gives tensors of 5 classes, 4 are named"):
        yolo.check_classes(outputs, 4, "n")
    ordinary = {"a": np.zeros((1, 40, 7)), "b": np.zeros((1, 32, 4, 4))}
    yolo.check_classes(ordinary, 4, "n")
    with pytest.raises(InputError, match="gives tensors of no classes"):
        yolo.check_classes({"a": np.zeros((1, 9, 7)), "b": np.zeros((1, 32, 4, 4))}, 4, "n")


def slow_suppress(found: yolo.Candidates, overlap: float) -> list[int]:
    def iou(a: np.ndarray, b: np.ndarray) -> float:
        wide = max(min(a[2], b[2]) - max(a[0], b[0]), 0.0)
        high = max(min(a[3], b[3]) - max(a[1], b[1]), 0.0)
        both = wide * high
        area = sum(float((c[2] - c[0]) * (c[3] - c[1])) for c in (a, b))
        return float(both / (area - both))

    kept: list[int] = []
    for k in sorted(range(len(found.score)), key=lambda k: -found.score[k]):
        rivals = [j for j in kept if found.column[j] == found.column[k]]
        if all(iou(found.box[k], found.box[j]) <= overlap for j in rivals):
            kept.append(k)
    return kept


def test_suppression_against_the_slow_twin() -> None:
    rng = np.random.default_rng(4)
    corner = rng.uniform(0, 60, (200, 2))
    box = np.concatenate([corner, corner + rng.uniform(5, 40, (200, 2))], axis=1).astype(np.float32)
    score = rng.permutation(200).astype(np.float32) / 200
    found = yolo.Candidates(box, score, rng.integers(0, 3, 200), np.zeros((200, 32), np.float32))
    kept = yolo.suppress(found, 0.5, 1000)
    expected = found.take(np.array(slow_suppress(found, 0.5)))
    np.testing.assert_array_equal(kept.box, expected.box)
    assert 3 < len(kept.score) < 200
    np.testing.assert_array_equal(yolo.suppress(found, 0.5, 7).score, expected.score[:7])


def test_a_mask_is_the_sigmoid_inside_its_box() -> None:
    rng = np.random.default_rng(5)
    protos = rng.normal(0, 1, (32, 20, 30)).astype(np.float32)
    coefficients = rng.normal(0, 1, 32).astype(np.float32)
    mask, x0, y0 = yolo.crop_mask(protos, coefficients, np.array([3.25, 2.0, 9.5, 30.0], np.float32))
    assert (x0, y0, mask.shape) == (3, 2, (18, 7))
    for y in range(18):
        for x in range(7):
            logit = sum(float(coefficients[k] * protos[k, y + 2, x + 3]) for k in range(32))
            share = {0: 0.75, 6: 0.5}.get(x, 1.0)  # of the cell inside the box
            assert mask[y, x] == pytest.approx(share / (1 + np.exp(-logit)), abs=1e-5)


def test_a_box_beyond_the_image_has_no_mask() -> None:
    protos = np.zeros((32, 20, 30), np.float32)
    mask, _, _ = yolo.crop_mask(protos, np.zeros(32, np.float32), np.array([-9.0, 2, -3, 8], np.float32))
    assert mask.size == 0


@pytest.mark.parametrize(
    ("image", "size", "fixed", "centred", "expected"),
    [
        ((360, 640), (448, 448), True, True, (448, 252, 0, 98, 448, 448)),
        ((360, 640), (448, 448), False, False, (448, 252, 0, 0, 448, 256)),
        ((100, 50), (64, 64), True, True, (32, 64, 16, 0, 64, 64)),
        ((1, 1000), (64, 64), False, False, (64, 1, 0, 0, 64, 32)),
    ],
)
def test_letterbox(
    image: tuple[int, int], size: tuple[int, int], fixed: bool, centred: bool, expected: tuple[int, ...]
) -> None:
    box = Letterbox.fit(image, size, fixed, 32, centred)
    assert (*box.content, box.left, box.top, box.width, box.height) == expected


def test_the_grid_finds_cells_where_the_image_was_laid() -> None:
    """A bright pixel block ends up in the cell that the grid says, whatever the scale and padding."""
    image = np.zeros((90, 160, 3), np.uint8)
    image[30:40, 100:110] = 255
    box = Letterbox.fit((90, 160), (320, 320), True, 32, True)
    filled = box.fill(image, 114, (0, 0, 0), (1, 1, 1))[0, 0]
    assert filled[0, 0] == pytest.approx(114 / 255)
    quarter = np.where(filled > 0.5, filled, 0.0).reshape(80, 4, 80, 4).mean(axis=(1, 3))
    ys, xs = np.nonzero(quarter > 0.5)
    grid = box.grid(80, 80)
    centre_u = (xs.mean() - grid.offset_x) / grid.scale_x
    centre_v = (ys.mean() - grid.offset_y) / grid.scale_y
    assert (centre_u, centre_v) == (pytest.approx(104.5, abs=0.51), pytest.approx(34.5, abs=0.51))
    rows, columns = box.cells(80, 80)
    assert (rows.start, rows.stop, columns.start, columns.stop) == (17, 63, 0, 80)  # of 320: 70..250


def test_normalisation() -> None:
    image = np.full((32, 32, 3), 51, np.uint8)
    box = Letterbox.fit((32, 32), (32, 32), True, 32, True)
    filled = box.fill(image, 0, (0.1, 0.2, 0.3), (0.5, 0.5, 0.25))
    np.testing.assert_allclose(filled[0, :, 5, 5], [0.2, 0.0, -0.4], atol=1e-6)


def test_boxes_return_to_the_image() -> None:
    box = Letterbox.fit((360, 640), (448, 448), True, 32, True)
    back = box.to_image(np.array([[0, 98, 448, 350], [-50, 0, 70, 133]], np.float32))
    np.testing.assert_allclose(back, [[0, 0, 640, 360], [0, 0, 100, 50]], atol=1e-3)


def test_samples_are_what_the_warped_layer_shows() -> None:
    rng = np.random.default_rng(6)
    dense = DenseScores((0, 3), rng.integers(0, 256, (9, 14, 2), np.uint8), Grid(0.25, 0.2, -0.3, 0.1))
    u, v = rng.integers(0, 50, 100), rng.integers(0, 40, 100)
    layer = dense.layer(3, 50, 40)
    np.testing.assert_allclose(dense.sample(u, v)[:, 1] * 255, layer[v, u], atol=6)
    one = DenseScores((0,), np.full((1, 1, 1), 51, np.uint8), Grid(1, 1, 0, 0))
    assert one.sample(np.array([-4.0, 9.0]), np.array([0.0, 3.0])).tolist() == [[pytest.approx(0.2)]] * 2
