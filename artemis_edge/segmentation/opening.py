"""From files to a backend at work: which kind a network is, whether it fits, and a first image through it."""

from __future__ import annotations

import ast
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.frames import U8
from artemis_edge.segmentation import yolo
from artemis_edge.segmentation.attribute import AttributeBackend
from artemis_edge.segmentation.backend import MOST_SLOTS, Backend, Prompt, Status
from artemis_edge.segmentation.clip import EmbeddingTable, ImageEncoder, TextEncoder, TextFeatures
from artemis_edge.segmentation.clip_tokens import Tokenizer
from artemis_edge.segmentation.fastsam_clip import FastSamClip
from artemis_edge.segmentation.manifest import Kind, Manifest
from artemis_edge.segmentation.network import Network
from artemis_edge.segmentation.openvocab_seg import OpenVocabulary
from artemis_edge.segmentation.semantic import Semantic
from artemis_edge.segmentation.words import canonical
from artemis_edge.segmentation.yolo_seg import Thresholds, YoloSeg

_SMOKE_SIZE = (120, 160)
_SMOKE_WORDS = ("person", "car", "tree")

#: Further files that a kind may have; which of them it needs is checked when it is opened.
ROLES: Mapping[Kind, tuple[str, ...]] = {
    "yolo-seg": (),
    "semantic": (),
    "fastsam-clip": ("image", "text", "vocabulary", "embeddings"),
    "openvocab-seg": ("text", "vocabulary", "embeddings"),
    "attribute": (),
}


def guess_kind(network: Network) -> Kind:
    """The kind that the tensors of a network tell; raises InputError where they fit none."""
    if len(network.inputs) == 2 and yolo.class_count(network.outputs) is not None:
        return "openvocab-seg"
    if len(network.inputs) == 1 and yolo.class_count(network.outputs) is not None:
        return "yolo-seg"
    outputs = list(network.outputs.values())
    if len(network.inputs) == 1 and len(outputs) == 1 and len(outputs[0]) == 4:
        return "semantic"
    raise InputError(
        f"{network.file} is of no kind that is known here: {tensors(network)}; see docs/models.md"
    )


def tensors(network: Network) -> str:
    """Inputs and outputs in words."""

    def listed(shapes: Mapping[str, tuple[int | None, ...]]) -> str:
        some = [f"{name} {[side or '?' for side in shape]}" for name, shape in list(shapes.items())[:6]]
        return ", ".join(some).replace("'", "")

    return f"it takes {listed(network.inputs)} and gives {listed(network.outputs)}"


def check_signature(network: Network, kind: Kind, classes: int) -> None:
    """Raises InputError where the tensors of a network are not those of its kind with so many classes."""
    images = next(iter(network.inputs.values()), ())
    inputs = 2 if kind == "openvocab-seg" else 1
    if len(network.inputs) != inputs or len(images) != 4 or images[1] not in (3, None):
        raise _misfit(network, kind)
    if kind == "semantic":
        outputs = list(network.outputs.values())
        if len(outputs) != 1 or len(outputs[0]) != 4:
            raise _misfit(network, kind)
        count = outputs[0][1] or 0
    else:
        found = yolo.class_count(network.outputs)
        if found is None:
            raise _misfit(network, kind)
        count = found
    if kind == "fastsam-clip" and count > 1:
        raise InputError(f"{network.file} has {count} classes; FastSAM has one: add it as --kind yolo-seg")
    if kind in ("yolo-seg", "semantic") and count not in (0, classes):
        raise InputError(
            f"{network.file} has {count} classes and {classes} names were given; "
            "name them with --classes FILE, one a line, in the order of the network"
        )


def _misfit(network: Network, kind: Kind) -> InputError:
    return InputError(
        f"{network.file} is not a network of kind {kind}: {tensors(network)}; see docs/models.md"
    )


def names_in(network: Network) -> tuple[str, ...]:
    """Class names that an export left in the file's metadata; empty where there are none."""
    try:
        said = ast.literal_eval(network.metadata.get("names", "{}"))
    except (ValueError, SyntaxError):
        return ()
    if not isinstance(said, dict) or sorted(said) != list(range(len(said))):
        return ()
    return tuple(str(said[k]) for k in range(len(said)))


def open_model(
    manifest: Manifest, folder: Path, thresholds: Thresholds | None = None, fine: bool = False
) -> Backend:
    """The backend of a model whose files are in ``folder``; raises InputError where something does not fit.

    ``fine``: nobody waits for it, so large images are read at the manifest's fine size, too, where it has one.
    """
    if manifest.kind == "attribute":
        return AttributeBackend()
    network = Network(folder / manifest.file)
    check_signature(network, manifest.kind, len(manifest.classes))
    if not fine:
        manifest = msgspec.structs.replace(manifest, fine_input_size=None)
    limits = thresholds or Thresholds()
    makers: dict[Kind, Callable[[], Backend]] = {
        "yolo-seg": lambda: YoloSeg(network, manifest, limits),
        "semantic": lambda: Semantic(network, manifest, limits),
        "openvocab-seg": lambda: OpenVocabulary(network, manifest, limits, _texts(manifest, folder)),
        "fastsam-clip": lambda: FastSamClip(
            network,
            manifest,
            limits,
            ImageEncoder(_part(manifest, folder, "image")),
            _texts(manifest, folder),
        ),
    }
    return makers[manifest.kind]()


def _part(manifest: Manifest, folder: Path, role: str) -> Network:
    if role not in manifest.parts:
        raise InputError(f"a model of kind {manifest.kind} needs its {role} encoder: give --part {role}=FILE")
    return Network(folder / manifest.parts[role].file)


def _texts(manifest: Manifest, folder: Path) -> TextFeatures:
    """The vectors of words: from a table where there is one, else by the text encoder."""
    if "embeddings" in manifest.parts:
        return EmbeddingTable(folder / manifest.parts["embeddings"].file, manifest.classes)
    if "vocabulary" not in manifest.parts:
        raise InputError(
            f"a model of kind {manifest.kind} needs --part text=FILE and --part vocabulary=FILE, "
            "or --part embeddings=FILE with --classes"
        )
    tokenizer = Tokenizer(folder / manifest.parts["vocabulary"].file)
    return TextEncoder(_part(manifest, folder, "text"), tokenizer)


@dataclass(frozen=True, slots=True)
class Smoke:
    """A first image went through: ``ms`` CPU time of the second one, ``words`` that were looked for."""

    ms: float
    words: tuple[str, ...]


def smoke_test(backend: Backend, size: tuple[int, int] = _SMOKE_SIZE) -> Smoke:
    """Two images of noise, of that size (height, width), through a backend; raises InputError where it fails."""
    words = [canonical(name) for name in backend.classes] or list(_SMOKE_WORDS)
    asked = [word for word in dict.fromkeys(words) if backend.support(word).status is Status.MATCHED][
        :MOST_SLOTS
    ]
    prompts = [Prompt(k + 1, word) for k, word in enumerate(asked)]
    ms = 0.0
    for seed in range(2):
        start = time.process_time()
        backend.segment(_noise(seed, size), prompts)
        ms = (time.process_time() - start) * 1e3
    return Smoke(ms, tuple(asked))


def _noise(seed: int, size: tuple[int, int]) -> U8:
    return np.random.default_rng(seed).integers(0, 256, (*size, 3), np.uint8)
