"""A yolo-seg network on an OAK camera: the archive it is loaded from, and its tensors decoded here.

The device only multiplies; boxes, suppression and masks are those of yolo_seg.py, so that the same network gives the
same instances wherever it runs. The archive (NN Archive, version 1.0) and the messages were tried with depthai 3.12
without a device; the network on a device was not.
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Mapping, Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np

from artemis_edge.errors import InputError, RunError
from artemis_edge.export.atomic import replacing
from artemis_edge.segmentation.backend import Prompt, Segmentation
from artemis_edge.segmentation.letterbox import Letterbox
from artemis_edge.segmentation.manifest import Manifest
from artemis_edge.segmentation.network import Array
from artemis_edge.segmentation.yolo_seg import YoloSeg

#: What a device runs (RVC2 and RVC4), and what the maker's converter takes.
_COMPILED = (".blob", ".superblob", ".dlc")
_CONVERTIBLE = (".onnx",)
_QUEUE = 2  # masks: the latest wins
_FULL = 255.0


def load_library() -> Any:
    """depthai; InputError where it is not installed."""
    try:
        import depthai
    except ImportError:
        raise InputError(
            "running a network on an OAK needs the extra: pip install 'artemis-edge[oak]'"
        ) from None
    return depthai


def archive_config(manifest: Manifest, executable: str) -> dict[str, Any]:
    """``config.json`` of an NN Archive: one image input, the raw tensors as outputs, no parser.

    The device puts its frames into RGB planes and divides as the network was trained.
    """
    (name, shape), *_ = manifest.inputs.items()
    size = [side or known for side, known in zip(shape, (1, 3, *manifest.input_size), strict=True)]
    preprocessing = {
        "mean": [_FULL * value for value in manifest.mean],
        "scale": [_FULL * value for value in manifest.std],
        "dai_type": "RGB888p",
    }
    image = {
        "name": name,
        "dtype": "float32",
        "input_type": "image",
        "shape": size,
        "layout": "NCHW",
        "preprocessing": preprocessing,
    }
    outputs = [{"name": output, "dtype": "float32"} for output in manifest.outputs]
    metadata = {"name": manifest.name, "path": executable, "precision": "float32"}
    return {
        "config_version": "1.0",
        "model": {"metadata": metadata, "inputs": [image], "outputs": outputs, "heads": []},
    }


def write_archive(out: Path, manifest: Manifest, executable: Path) -> None:
    """Write an NN Archive (.tar.xz) of a registered network.

    ``executable`` is the network compiled for the device (.blob, .superblob, .dlc), or the ONNX file, for the
    maker's converter. Raises InputError where it is neither or the network is not of kind yolo-seg.
    """
    if manifest.kind != "yolo-seg":
        raise InputError(f"{manifest.name} is of kind {manifest.kind}; an OAK runs yolo-seg networks")
    if executable.suffix not in (*_COMPILED, *_CONVERTIBLE):
        kinds = ", ".join((*_COMPILED, *_CONVERTIBLE))
        raise InputError(f"{executable} is not a network that an archive can hold; give one of {kinds}")
    name = f"{manifest.name}{executable.suffix}"
    config = json.dumps(archive_config(manifest, name), indent=1).encode()
    try:
        content = executable.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {executable}: {error.strerror}") from None
    with replacing(out) as file, tarfile.open(fileobj=file, mode="w:xz") as archive:
        for member, data in (("config.json", config), (name, content)):
            entry = tarfile.TarInfo(member)  # without times and owners: the same network gives the same bytes
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))


def tensors(message: Any, outputs: Sequence[str]) -> dict[str, Array]:
    """The network's outputs by name, float32 with their shapes, of a depthai ``NNData`` message."""
    there = list(message.getAllLayerNames())
    missing = [name for name in outputs if name not in there]
    if missing:
        raise RunError(
            f"the camera's network does not give {missing[0]} (it gives {', '.join(there) or 'nothing'}); "
            "convert the registered network again"
        )
    return {name: np.asarray(message.getTensor(name), np.float32) for name in outputs}


def stretched(image: tuple[int, int], size: tuple[int, int]) -> Letterbox:
    """How the device lays an image (height, width) into the input ``size``: centred, proportions kept."""
    return Letterbox.fit(image, size, fixed=True, stride=1, centred=True)


class OakMasks:
    """Masks of one camera of an OAK, computed on the device, late by a frame or two."""

    def __init__(self, backend: YoloSeg, manifest: Manifest, image: tuple[int, int]) -> None:
        """``image`` is (height, width) of the camera's photographs that the masks belong to."""
        self._backend = backend
        self._outputs = tuple(manifest.outputs)
        self._box = stretched(image, manifest.input_size)
        self._queue: Any = None

    def attach(self, pipeline: Any, camera: Any, archive: Path, rate_hz: float) -> None:
        """Add the network to a depthai pipeline, fed by ``camera`` (a Camera node) at ``rate_hz``.

        Raises RunError where depthai refuses it.
        """
        dai = load_library()
        try:
            model = dai.NNArchive(str(archive))
            network = pipeline.create(dai.node.NeuralNetwork).build(
                camera, model, fps=rate_hz, resizeMode=dai.ImgResizeMode.LETTERBOX
            )
            self._queue = network.out.createOutputQueue(maxSize=_QUEUE, blocking=False)
        except RuntimeError as error:
            what = " ".join(str(error).split())[:160]
            raise RunError(f"the camera does not take the network {archive.name} ({what})") from None

    def fetch(self, prompts: Sequence[Prompt], timeout_s: float) -> tuple[int, Segmentation] | None:
        """The next masks and the sequence number of their photograph; None where none came in time."""
        message = self._queue.get(timedelta(seconds=timeout_s))
        return None if message is None else self.parse(message, prompts)

    def parse(self, message: Any, prompts: Sequence[Prompt]) -> tuple[int, Segmentation]:
        """Masks of an ``NNData`` message, and the sequence number of the photograph that they belong to."""
        found: Mapping[str, Array] = tensors(message, self._outputs)
        return int(message.getSequenceNum()), self._backend.decode(found, self._box, prompts)
