"""Calibrates learnt weights and writes them as the shipped network: an ONNX file and its manifest.

    python training/export.py --weights WEIGHTS.pt --calibrate VIEWS --out artemis_edge/segmentation/shipped

Learning weighs rare classes and rims more than they count, so that its probabilities are not those of pixels:
a temperature and a bias for each class, fitted on views that were not learnt from (Guo et al., "On calibration of
modern neural networks", 2017), go into the last layer. Weights are stored in 16 bits and computed with in 32.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import onnx
import torch
from labels import IGNORED, NETWORK_CLASSES
from network import Network
from onnx import TensorProto, helper, numpy_helper
from samples import FINE_INPUT, INPUT, Views, whole
from torch import Tensor
from torch.nn import functional

NAME = "virtual-worlds"
_STRIDE = 32
_OPSET = 17
_EVERY = 3  # cells and rows of cells used for calibration
_SMALLEST = 256  # numbers; smaller tensors stay in 32 bits
_PULL = 1e-3  # of the biases towards 0
_NOTE = (
    "Trained by this project on its own virtual worlds only: it knows their things and textures, "
    "and is of no use on photographs of the real world."
)


def calibrate(network: Network, views: Views) -> tuple[float, Tensor]:
    """Put temperature and biases into the last layer; returns them."""
    logits, labels = _cells(network, views)
    log_temperature = torch.zeros(1, requires_grad=True)
    bias = torch.zeros(logits.shape[1], requires_grad=True)
    optimiser = torch.optim.LBFGS([log_temperature, bias], max_iter=60, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimiser.zero_grad()
        loss = functional.cross_entropy(logits * torch.exp(-log_temperature) + bias, labels)
        loss = loss + _PULL * (bias**2).mean()
        loss.backward()
        return loss

    optimiser.step(closure)  # type: ignore[arg-type]
    cooler = torch.exp(-log_temperature).detach()
    with torch.no_grad():
        network.logits.weight *= cooler
        assert network.logits.bias is not None
        # each class has the four logits of a cell, one after another
        network.logits.bias.copy_(network.logits.bias * cooler + bias.repeat_interleave(4))
    return float(1 / cooler), bias.detach()


def class_shares(views: Views) -> list[float]:
    """Share of each class in the labelled pixels of the views that probabilities are calibrated on."""
    count = sum(
        np.bincount(label[label != IGNORED].ravel(), minlength=len(NETWORK_CLASSES)) for label in views.labels
    )
    return [round(float(share), 5) for share in count / np.sum(count)]


def _cells(network: Network, views: Views) -> tuple[Tensor, Tensor]:
    """Logits (n, classes) and labels (n,) of cells spread over the views."""
    logits, labels = [], []
    with torch.inference_mode():
        for photo, label in zip(views.photos, views.labels, strict=True):
            found = network(torch.from_numpy(whole(photo)))[0]
            rows, columns = found.shape[1:]
            named = cv2.resize(label, (columns, rows), interpolation=cv2.INTER_NEAREST)[::_EVERY, ::_EVERY]
            found = found[:, ::_EVERY, ::_EVERY]
            known = named != IGNORED
            logits.append(found[:, torch.from_numpy(known)].T)
            labels.append(torch.from_numpy(named[known].astype(np.int64)))
    return torch.cat(logits).clone(), torch.cat(labels).clone()


def halved(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model with its larger weights as float16, cast back where they are used."""
    kept, casts = [], []
    for tensor in model.graph.initializer:
        if tensor.data_type != TensorProto.FLOAT or np.prod(tensor.dims) < _SMALLEST:
            kept.append(tensor)
            continue
        stored = numpy_helper.from_array(
            numpy_helper.to_array(tensor).astype(np.float16), f"{tensor.name}.16"
        )
        kept.append(stored)
        casts.append(helper.make_node("Cast", [stored.name], [tensor.name], to=TensorProto.FLOAT))
    nodes = [*casts, *model.graph.node]
    del model.graph.initializer[:], model.graph.node[:]
    model.graph.initializer.extend(kept)
    model.graph.node.extend(nodes)
    onnx.checker.check_model(model, full_check=True)
    return model


def write(network: Network, folder: Path, shares: Sequence[float]) -> Path:
    """``NAME.onnx`` and ``NAME.json``; ``shares`` as of :func:`class_shares`."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{NAME}.onnx"
    example = torch.zeros(1, 3, INPUT[1], INPUT[0])
    names = {"input_names": ["image"], "output_names": ["logits"]}
    torch.onnx.export(
        network,
        (example,),
        str(path),
        opset_version=_OPSET,
        dynamic_axes={"image": {2: "height", 3: "width"}, "logits": {2: "rows", 3: "columns"}},
        dynamo=False,
        **names,
    )
    model = halved(onnx.load(str(path)))
    model.graph.doc_string = _NOTE
    onnx.save(model, str(path))
    _write_manifest(path, shares)
    return path


def _write_manifest(path: Path, shares: Sequence[float]) -> None:
    manifest = {
        "name": NAME,
        "kind": "semantic",
        "file": path.name,
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "licence": "that of this program",
        "classes": list(NETWORK_CLASSES),
        "shares": list(shares),
        "input_size": [INPUT[1], INPUT[0]],
        "fine_input_size": [FINE_INPUT[1], FINE_INPUT[0]],
        "stride": _STRIDE,
        "inputs": {"image": [1, 3, 0, 0]},
        "outputs": {"logits": [1, len(NETWORK_CLASSES), 0, 0]},
        "synthetic_only": True,
        "source": "training/ in the source tree: make train",
        "note": _NOTE,
    }
    path.with_suffix(".json").write_text(json.dumps(manifest, indent=1) + "\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Calibrate and write."""
    parser = argparse.ArgumentParser(prog="python training/export.py")
    parser.add_argument("--weights", type=Path, required=True)
    parser.add_argument("--calibrate", type=Path, required=True, help="folder of views")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    network = Network(len(NETWORK_CLASSES))
    network.load_state_dict(torch.load(given.weights))
    network.eval()
    views = Views(sorted(given.calibrate.glob("*.npz")))
    temperature, bias = calibrate(network, views)
    spread = ", ".join(f"{n} {b:+.2f}" for n, b in zip(NETWORK_CLASSES, bias.tolist(), strict=True))
    print(f"temperature {temperature:.3f}; biases {spread}")
    path = write(network, given.out, class_shares(views))
    print(f"{path}: {path.stat().st_size} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
