"""The archive for an OAK, and its messages; those need depthai, which is an extra."""

import json
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from artemis_edge.errors import InputError, RunError
from artemis_edge.segmentation import oak
from artemis_edge.segmentation.backend import Prompt
from artemis_edge.segmentation.manifest import Manifest
from artemis_edge.segmentation.network import Network
from artemis_edge.segmentation.opening import open_model
from artemis_edge.segmentation.yolo_seg import PAD, YoloSeg
from tests import networks

CAR = [Prompt(1, "car")]


@pytest.fixture
def manifest(tmp_path: Path) -> Manifest:
    network = Network(networks.yolo_export(tmp_path / "model.onnx"))
    return Manifest(
        name="colours", kind="yolo-seg", file="model.onnx", sha256="0" * 64, licence="ours",
        classes=networks.CLASSES, input_size=(160, 160),
        inputs={key: tuple(side or 0 for side in shape) for key, shape in network.inputs.items()},
        outputs={key: tuple(side or 0 for side in shape) for key, shape in network.outputs.items()},
    )  # fmt: skip


class Message:
    """As depthai's NNData."""

    def __init__(self, tensors: dict[str, np.ndarray], number: int = 41) -> None:
        self._tensors, self._number = tensors, number

    def getAllLayerNames(self) -> list[str]:
        return list(self._tensors)

    def getTensor(self, name: str) -> np.ndarray:
        return self._tensors[name]

    def getSequenceNum(self) -> int:
        return self._number


def outputs_of(folder: Path) -> dict[str, np.ndarray]:
    box = oak.stretched((120, 160), (160, 160))
    return Network(folder / "model.onnx").run(box.fill(networks.photograph(), PAD, (0, 0, 0), (1, 1, 1)))


def masks(manifest: Manifest, folder: Path) -> tuple[oak.OakMasks, YoloSeg]:
    backend = open_model(manifest, folder)
    assert isinstance(backend, YoloSeg)
    return oak.OakMasks(backend, manifest, (120, 160)), backend


def test_the_archive_says_how_the_network_is_fed(manifest: Manifest, tmp_path: Path) -> None:
    (tmp_path / "n.blob").write_bytes(b"compiled")
    for name in ("a.tar.xz", "b.tar.xz"):
        oak.write_archive(tmp_path / name, manifest, tmp_path / "n.blob")
    assert (tmp_path / "a.tar.xz").read_bytes() == (tmp_path / "b.tar.xz").read_bytes()
    with tarfile.open(tmp_path / "a.tar.xz") as archive:
        assert archive.getnames() == ["config.json", "colours.blob"]
        said: Any = json.load(archive.extractfile("config.json"))  # type: ignore[arg-type]
        assert archive.extractfile("colours.blob").read() == b"compiled"  # type: ignore[union-attr]
    assert said["model"]["metadata"]["path"] == "colours.blob"
    (image,) = said["model"]["inputs"]
    assert (image["name"], image["shape"], image["preprocessing"]["scale"]) == (
        "images",
        [1, 3, 160, 160],
        [255.0] * 3,
    )
    assert [output["name"] for output in said["model"]["outputs"]] == ["output0", "output1"]


def test_what_no_archive_can_hold(manifest: Manifest, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"give one of \.blob"):
        oak.write_archive(tmp_path / "a", manifest, tmp_path / "n.pt")
    with pytest.raises(InputError, match="cannot read"):
        oak.write_archive(tmp_path / "a", manifest, tmp_path / "gone.blob")
    other = Manifest(name="s", kind="semantic", file="f", sha256="0" * 64, licence="")
    with pytest.raises(InputError, match="an OAK runs yolo-seg networks"):
        oak.write_archive(tmp_path / "a", other, tmp_path / "model.onnx")
    assert not (tmp_path / "a").exists()


def test_the_device_s_tensors_give_the_same_masks(manifest: Manifest, tmp_path: Path) -> None:
    there, backend = masks(manifest, tmp_path)
    number, found = there.parse(Message(outputs_of(tmp_path)), CAR)
    here = backend.segment(networks.photograph(), CAR)
    assert number == 41
    np.testing.assert_array_equal(found.dense.score, here.dense.score)
    assert len(found.instances) == len(here.instances) > 0


def test_another_network_on_the_device_is_told(manifest: Manifest, tmp_path: Path) -> None:
    there, _ = masks(manifest, tmp_path)
    with pytest.raises(RunError, match=r"does not give output0 \(it gives other\)"):
        there.parse(Message({"other": np.zeros(3)}), CAR)


def test_with_depthai_itself(manifest: Manifest, tmp_path: Path) -> None:
    dai = pytest.importorskip("depthai")
    oak.write_archive(tmp_path / "a.tar.xz", manifest, tmp_path / "model.onnx")
    archive = dai.NNArchive(str(tmp_path / "a.tar.xz"))
    assert archive.getInputSize() == (160, 160)
    assert [output.name for output in archive.getConfig().model.outputs] == ["output0", "output1"]
    message = dai.NNData()
    message.setSequenceNum(7)
    for name, value in outputs_of(tmp_path).items():
        message.addTensor(name, value, dataType=dai.TensorInfo.DataType.FP32)
    there, backend = masks(manifest, tmp_path)
    number, found = there.parse(message, CAR)
    assert number == 7
    here = backend.segment(networks.photograph(), CAR)
    np.testing.assert_allclose(found.dense.score, here.dense.score, atol=1)
