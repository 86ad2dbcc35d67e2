"""Small networks with the tensors of real ones, built by hand: they see colours.

Classes are red things ("car"), green things ("person") and blue things ("bench") on black; a mask is what is bright.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

CLASSES = ("car", "person", "bench")
MASKS = 32
GAIN = 20.0
OPSET = 17
WORDS = ("car", "person", "tree")
TOKENS = 49408
RGB = np.array([[1, -1, -1], [-1, 1, -1], [-1, -1, 1]], np.float32)


def photograph(height: int = 120, width: int = 160) -> np.ndarray:
    """Black, with a red square (x 10..50, y 30..70) and a green one (x 90..130, y 10..50); uint8 RGB."""
    image = np.zeros((height, width, 3), np.uint8)
    image[30:70, 10:50, 0] = 255
    image[10:50, 90:130, 1] = 255
    return image


RED, GREEN = (slice(30, 70), slice(10, 50)), (slice(10, 50), slice(90, 130))


class Graph:
    """Collects nodes and constants."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def node(self, operator: str, *inputs: str, name: str = "", **attributes: Any) -> str:
        out = name or f"t{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, list(inputs), [out], **attributes))
        return out

    def constant(self, value: Any) -> str:
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value), name))
        return name

    def pooled(self, source: str, side: int) -> str:
        return self.node("AveragePool", source, kernel_shape=[side, side], strides=[side, side])

    def mixed(self, source: str, weight: np.ndarray, bias: np.ndarray, name: str = "") -> str:
        """1 x 1 convolution; ``weight`` (out, 3)."""
        w = self.constant(weight.astype(np.float32)[:, :, None, None])
        return self.node("Conv", source, w, self.constant(bias.astype(np.float32)), name=name)

    def protos(self, side: int, name: str) -> str:
        """Channel 0 is the logit of brightness, the others are 0."""
        weight, bias = np.zeros((MASKS, 3)), np.zeros(MASKS)
        weight[0], bias[0] = GAIN, -GAIN / 2
        return self.mixed(self.pooled("images", side), weight, bias, name)

    def save(
        self, path: Path, inputs: dict[str, list[Any]], outputs: dict[str, list[Any]],
        opset: int = OPSET, metadata: dict[str, str] | None = None, integers: bool = False,
    ) -> Path:  # fmt: skip
        kind = TensorProto.INT64 if integers else TensorProto.FLOAT
        graph = helper.make_graph(
            self.nodes,
            "test",
            [helper.make_tensor_value_info(name, kind, shape) for name, shape in inputs.items()],
            [
                helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
                for name, shape in outputs.items()
            ],
            self.constants,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=10)
        for key, value in (metadata or {}).items():
            model.metadata_props.add(key=key, value=value)
        onnx.save(model, str(path))
        return path


def _class_logits(classes: int) -> tuple[np.ndarray, np.ndarray]:
    weight = RGB[:classes] if classes > 1 else np.ones((1, 3), np.float32)
    return GAIN * weight, np.full(len(weight), -GAIN / 2)


def yolo_export(
    path: Path, size: int = 160, classes: int = 3, texts: bool = False, told: bool = True, **more: Any
) -> Path:
    """The ordinary export: a candidate of 40 x 40 pixels every 20 pixels; ``texts`` adds an input [1, K, 3].

    Without ``told`` the file does not say how many classes it has.
    """
    step = 20
    side = size // step
    graph = Graph()
    cells = graph.pooled("images", step)
    flat = graph.node("Reshape", cells, graph.constant(np.array([1, 3, -1])))
    if texts:
        gain = graph.constant(np.float32(GAIN))
        logits = graph.node("Mul", graph.node("MatMul", "texts", flat), gain)
        logits = graph.node("Sub", logits, graph.constant(np.float32(GAIN / 2)))
    else:
        weight, bias = _class_logits(classes)
        logits = graph.node("MatMul", graph.constant(weight.astype(np.float32)), flat)
        logits = graph.node("Add", logits, graph.constant(bias.astype(np.float32)[None, :, None]))
    scores = graph.node("Sigmoid", logits)
    ys, xs = np.divmod(np.arange(side * side), side)
    boxes = np.stack([(xs + 0.5) * step, (ys + 0.5) * step, *np.full((2, side * side), 2.0 * step)])
    coefficients = np.zeros((1, MASKS, side * side), np.float32)
    coefficients[0, 0] = 1.0
    fixed = graph.constant(boxes.astype(np.float32)[None])
    graph.node("Concat", fixed, scores, graph.constant(coefficients), name="output0", axis=1)
    graph.protos(4, "output1")
    inputs: dict[str, list[Any]] = {"images": [1, 3, size, size]}
    if texts:
        inputs["texts"] = [1, None, 3]
    rows = None if texts or not told else 4 + classes + MASKS
    outputs = {"output0": [1, rows, side * side], "output1": [1, MASKS, size // 4, size // 4]}
    return graph.save(path, inputs, outputs, **more)


def yolo_raw(path: Path, **more: Any) -> Path:
    """Raw heads of any size; every edge is 2.5 strides from its anchor."""
    graph = Graph()
    outputs: dict[str, list[Any]] = {"proto": [1, MASKS, None, None]}
    for stride in (8, 16, 32):
        cells = graph.pooled("images", stride)
        bins = np.zeros((4, 16))
        bins[:, 2:4] = GAIN  # half of the weight at 2, half at 3
        graph.mixed(cells, np.zeros((64, 3)), bins.reshape(-1), f"box{stride}")
        weight, bias = _class_logits(3)
        never = 100.0 if stride == 32 else 0.0  # such a box would hold both squares
        graph.mixed(cells, weight, bias - never, f"cls{stride}")
        one = np.zeros(MASKS)
        one[0] = 1.0
        graph.mixed(cells, np.zeros((MASKS, 3)), one, f"coef{stride}")
        outputs.update(
            {f"{what}{stride}": [1, n, None, None] for what, n in (("box", 64), ("cls", 3), ("coef", MASKS))}
        )
    graph.protos(4, "proto")
    return graph.save(path, {"images": [1, 3, None, None]}, outputs, **more)


def semantic(
    path: Path, size: tuple[Any, Any] = (None, None), bias: float = 0.0, told: bool = True, **more: Any
) -> Path:
    """Logits at a quarter of the size: background, car, person, bench. ``told`` and the ``bias`` of background."""
    graph = Graph()
    weight = np.concatenate([np.zeros((1, 3)), GAIN * RGB])
    biases = np.array([bias, *np.full(3, -GAIN / 2)])
    graph.mixed(graph.pooled("images", 4), weight, biases, "logits")
    cells = [side // 4 if side else None for side in size]
    return graph.save(path, {"images": [1, 3, *size]}, {"logits": [1, 4 if told else None, *cells]}, **more)


def image_encoder(path: Path, batch: int | None = None) -> Path:
    """The mean colour that is missing to white becomes the vector: red on white is (0, -1, -1)."""
    graph = Graph()
    mean = graph.node("GlobalAveragePool", "pixels")
    graph.node("Reshape", mean, graph.constant(np.array([-1, 3])), name="features")
    return graph.save(path, {"pixels": [batch, 3, 32, 32]}, {"features": [batch, 3]})


def text_encoder(path: Path, vectors: dict[int, np.ndarray], batch: int | None = None) -> Path:
    """A vector by token id, 0 for all others, summed over the text."""
    table = np.zeros((TOKENS, 3), np.float32)
    for token, vector in vectors.items():
        table[token] = vector
    graph = Graph()
    graph.node("ReduceSum", graph.node("Gather", graph.constant(table), "ids"), graph.constant(np.array([1])),
               name="vectors", keepdims=0)  # fmt: skip
    return graph.save(path, {"ids": [batch, 77]}, {"vectors": [batch, 3]}, integers=True)


def vocabulary(path: Path) -> dict[str, int]:
    """A vocabulary file of CLIP's form that merges the WORDS; returns their ids."""
    merges: list[tuple[str, str]] = []
    ids = {}
    for word in WORDS:
        done = word[0]
        for letter in [*word[1:-1], word[-1] + "</w>"]:
            if (done, letter) not in merges:
                merges.append((done, letter))
            done += letter
        ids[word] = 512 + merges.index((done.removesuffix(letter), letter))
    merges += [(f"<{k}", ">") for k in range(TOKENS - 514 - len(merges))]
    path.write_text("#version: test\n" + "".join(f"{a} {b}\n" for a, b in merges), "utf-8")
    return ids
