"""The stages with masks: classes where they belong, same input same bytes; the same of a finished mesh (``ask``)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from artemis_edge.ask import MeshBrush
from artemis_edge.config import Config, MesherConfig, RefinementConfig, SemanticsConfig, VoxelMapConfig
from artemis_edge.export.mesh import Mesh
from artemis_edge.export.ply import read_mesh
from artemis_edge.frames import U8, CameraImage, CameraModel, SyncedFrame, TrackedFrame
from artemis_edge.pipeline import BASE_MB, Pipeline
from artemis_edge.segmentation.backend import DenseScores, Grid, Segmentation
from artemis_edge.segmentation.keyframes import Keyframe
from artemis_edge.semantic_map import LateMask
from artemis_edge.sight import Sight
from tests import naive

CAMERA = CameraModel(160, 128, 90.0, 90.0, 79.5, 63.5)
AHEAD = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])  # T_cam_lidar: along x
PLACES = [(0.25 * k, 0.0, 0.1) for k in range(16)]
FLOOR, LEFT = 1, 2


@pytest.fixture(autouse=True)
def _closed_files() -> Iterator[None]:
    with naive.closing_page_files():
        yield


class Corridor:
    """Masks of the floor and the left wall of ``naive.corridor``, each a frame late; every fifth is of nonsense."""

    names = ("floor", "left wall")

    def __init__(self) -> None:
        self._offered: list[tuple[Sight, int]] = []

    def offer(self, image: CameraImage, look: Callable[[], Sight]) -> None:
        self._offered.append((look(), image.stamp_ns))

    def ready(self) -> list[LateMask]:
        due, self._offered = self._offered[:-1], self._offered[-1:]
        return [LateMask(sight, scores(stamp // 100_000_000)) for sight, stamp in due]

    def drain(self) -> list[LateMask]:
        return [LateMask(sight, scores(stamp // 100_000_000)) for sight, stamp in self._offered]


def scores(index: int) -> DenseScores:
    """What a camera in the corridor's middle sees, whatever its x."""
    v, u = np.mgrid[0:128:2, 0:160:2].astype(np.float64)
    right, down = (u - 79.5) / 90.0, (v - 63.5) / 90.0
    # the floor lies 1.05 m below the camera, the ceiling as far above; the walls are 1.05 m away
    label: U8 = np.where(
        np.abs(down) > np.abs(right), np.where(down > 0, FLOOR, 0), np.where(right < 0, LEFT, 0)
    )
    if index % 5 == 4:
        label = np.asarray((label + 1) % 3)
    score = np.zeros((*label.shape, 3), np.uint8)
    np.put_along_axis(score, label[:, :, None].astype(np.int64), np.uint8(240), axis=2)
    return DenseScores((0, 1, 2), score, Grid(0.5, 0.5, 0.0, 0.0))


class Photographed(naive.KnownPoses):
    """Known poses that hand on the photographs of a frame."""

    def track(self, frame: SyncedFrame) -> TrackedFrame:
        tracked = super().track(frame)
        return replace(tracked, images=frame.images, image_poses=(tracked.T_world_lidar,) * len(frame.images))


def run(folder: Path, **semantics: float | bool) -> Pipeline:
    folder.mkdir()
    config = Config(
        voxel_map=VoxelMapConfig(memory_budget_mb=BASE_MB + 30),
        mesher=MesherConfig(),
        refinement=RefinementConfig(enabled=False),
        semantics=SemanticsConfig(**semantics),  # type: ignore[arg-type]
    )
    pipeline = Pipeline(config, Photographed(PLACES), folder, Corridor())
    for frame in naive.corridor(PLACES, 1500):
        image = CameraImage("cam", frame.stamp_ns, b"", CAMERA, AHEAD)
        pipeline.process(replace(frame, images=(image,)))
    pipeline.finish()
    pipeline.write_mesh(folder / "mesh.ply")
    pipeline.save(folder / "map")
    return pipeline


def share_right(mesh: Mesh) -> float:
    """Of the vertices in the middle of a side, those that have its label."""
    p = mesh.vertices
    beside, below = np.abs(p[:, 1]) > 0.98, np.abs(p[:, 2] - 0.1) > 0.98
    truth = np.where(below & (p[:, 2] < 0), FLOOR, np.where(beside & (p[:, 1] > 0), LEFT, 0))
    judged = (beside ^ below) & (p[:, 0] > 1.5) & (p[:, 0] < 6.0)
    judged &= np.minimum(np.abs(np.abs(p[:, 1]) - 1.05), np.abs(np.abs(p[:, 2] - 0.1) - 1.05)) < 0.05
    return float((mesh.labels[judged] == truth[judged]).mean())


def test_masks_label_the_map_and_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        run(tmp_path / name)
    mesh = read_mesh(tmp_path / "a" / "mesh.ply")
    assert mesh.label_names == {0: "background", 1: "floor", 2: "left wall"}
    assert share_right(mesh) > 0.97
    naive.assert_manifold(mesh.faces.astype(np.int64))
    for file in ("mesh.ply", "map/blocks.bin", "map/config.toml"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file


def test_a_finished_mesh_is_labelled_by_its_photographs(tmp_path: Path) -> None:
    run(tmp_path / "a")
    mesh = read_mesh(tmp_path / "a" / "mesh.ply")
    mesh = replace(mesh, labels=np.zeros(len(mesh.vertices), np.uint8), label_names={0: "background"})
    found = []
    for _ in range(2):
        brush = MeshBrush(mesh, Corridor.names, SemanticsConfig(), 0.1)
        for index, place in enumerate(PLACES):
            T = np.linalg.inv(AHEAD)
            T[:3, 3] = place
            keyframe = Keyframe(Path("none"), "cam", index, CAMERA, T)
            assert brush.refine(keyframe, Segmentation(160, 128, (), (), scores(index))) > 100
        labelled, probability = brush.labelled()
        assert share_right(labelled) > 0.97 and probability.max() <= 1.0
        found.append(labelled.labels.tobytes() + probability.tobytes())
    assert found[0] == found[1]
