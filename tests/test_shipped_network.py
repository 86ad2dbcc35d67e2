"""The network that ships: the file of its manifest, small, and good on views of a world that it has not seen."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from artemis_drivers.virtual.mesh_builder import CLASS_NAMES
from artemis_drivers.virtual.scene import Scene
from numpy.typing import NDArray

from artemis_edge.segmentation.backend import Backend, Prompt, Status
from artemis_edge.segmentation.manifest import Manifest, read_manifest
from artemis_edge.segmentation.opening import open_model
from artemis_edge.segmentation.registry import file_hash, shipped_folder
from artemis_edge.segmentation.trial import decode
from artemis_edge.session.rig import build_rig, read_settings

U8 = NDArray[np.uint8]
LARGEST = 1_000_000  # bytes
SEED = 77  # training draws seeds of 10000 and more
WORDS = ("ground", "building", "person", "bench", "tree", "backpack")
LEAST_IOU = {"ground": 0.94, "building": 0.9, "bench": 0.55, "tree": 0.65, "person": 0.45}


def described() -> tuple[Manifest, Path]:
    (path,) = shipped_folder().glob("*.json")
    return read_manifest(path), path.parent


def classes_seen(scene: Scene, triangles: NDArray[np.int32]) -> U8:
    """Of each pixel's first quarter; a pane counts as building."""
    first = triangles[:, :, 0]
    found = np.where(first >= 0, scene.class_id[first], 0)
    found[found == CLASS_NAMES.index("glass")] = CLASS_NAMES.index("building")
    return found.astype(np.uint8)


def test_it_is_small_and_the_file_of_its_manifest_and_says_what_it_is_for() -> None:
    manifest, folder = described()
    files = [path for path in folder.iterdir() if path.suffix == ".onnx"]
    assert [path.name for path in files] == [manifest.file]
    assert sum(path.stat().st_size for path in folder.iterdir()) <= LARGEST
    assert file_hash(folder / manifest.file) == manifest.sha256
    assert manifest.synthetic_only and "virtual worlds only" in manifest.note
    assert set(manifest.classes) == set(CLASS_NAMES) - {"glass"}
    assert len(manifest.shares) == len(manifest.classes)
    assert abs(sum(manifest.shares) - 1.0) < 1e-3


@pytest.fixture(scope="module")
def backend() -> Backend:
    return open_model(*described())


def test_it_labels_views_of_a_world_that_it_has_not_seen(backend: Backend) -> None:
    rig = build_rig("bench", SEED, 8.0, "avia", read_settings({"imu": "off", "image_width": "480"}))
    camera = rig.new_camera()
    prompts = [Prompt(k + 1, word) for k, word in enumerate(WORDS)]
    hit, union = np.zeros(len(WORDS)), np.zeros(len(WORDS))
    for index, time_s in enumerate((0.0, 3.0, 6.0)):
        scene = rig.window.at(rig.x_at(time_s))
        photo = camera.photograph(scene, rig.world.sun, rig.camera_pose, time_s, index)
        image = decode(photo.data)
        assert image is not None
        seen = backend.segment(image, prompts)
        assert [answer.prompt.text for answer in seen.answers] == list(WORDS)
        v, u = np.mgrid[0 : image.shape[0], 0 : image.shape[1]]
        best = seen.dense.sample(u.reshape(-1), v.reshape(-1)).argmax(axis=1).reshape(u.shape)
        true = classes_seen(scene, camera.seen()[0])
        for k, word in enumerate(WORDS):
            found = best == seen.dense.slots.index(k + 1)
            there = true == CLASS_NAMES.index(word)
            hit[k] += (found & there).sum()
            union[k] += (found | there).sum()
    iou = dict(zip(WORDS, hit / union, strict=True))
    print({word: round(float(value), 3) for word, value in iou.items()})
    assert all(iou[word] >= least for word, least in LEAST_IOU.items()), iou


def test_what_it_has_no_word_for_is_unsupported(backend: Backend) -> None:
    image = np.zeros((96, 128, 3), np.uint8)
    seen = backend.segment(image, [Prompt(1, "giraffe"), Prompt(2, "car")])
    assert seen.answers[0].status is Status.UNSUPPORTED
    assert seen.dense.slots == (0, 2)
