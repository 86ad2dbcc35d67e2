"""What several test files share: a small mapper in place of the pipeline, and small inputs."""

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from artemis_edge.export.ply import Mesh, bare_mesh, write_ply
from artemis_edge.frames import F32, F64, CameraModel, MeshDelta, Odometry, SyncedFrame, TrackedFrame
from artemis_edge.load import Load
from artemis_edge.refinement.stage import GoOn, always
from artemis_edge.sight import Sight, new_sight

# In this order, before all others: what compiles kernels that many need, and beside it what needs none of them; then
# files that take long, so that no worker waits for the other's last one; those at the LiDAR's ports apart.
_FIRST = (
    "test_pipeline", "test_simulate", "test_continuing", "test_livox_driver", "test_virtual_worlds", "test_mesher",
    "test_service", "test_refinement", "test_runtime", "test_bad_input", "test_tui_terminal", "test_replug",
    "test_demo", "test_voxel_map", "test_odometry_propagation", "test_livox_mid360", "test_report",
    "test_stream_mapping", "test_paging", "test_daemon",
)  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files in the order in which two workers are done with them soonest."""
    rank = {name: k for k, name in enumerate(_FIRST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


class FakeMapper:
    """Tracks frames with the real odometry and makes one triangle of each; can be told to fail."""

    def __init__(self, odometry: Odometry) -> None:
        self.odometry = odometry
        self.stage_ms: dict[str, float] = {}
        self.trajectory: list[tuple[int, F64]] = []
        self.tracked: TrackedFrame | None = None
        self.lost: dict[str, int] = {}
        self.finished = False
        self.earlier: list[object] = []
        self.before_frame: Callable[[int], None] = lambda index: None

    def process(self, frame: SyncedFrame) -> MeshDelta:
        self.before_frame(frame.index)
        tracked = self.tracked = self.odometry.track(frame)
        self.trajectory.append((tracked.stamp_ns, tracked.T_world_lidar))
        self.stage_ms = {"odometry": 1.0, "mesher": 2.0}
        empty, ids, triples = np.empty((0, 3)), np.zeros(1, np.int64), np.empty((0, 3), np.int64)
        f32, u8 = empty.astype(np.float32), empty.astype(np.uint8)
        return MeshDelta(
            frame.index,
            triples.astype(np.int32),
            ids,
            ids,
            ids[:0],
            f32,
            f32,
            u8,
            u8[:, 0],
            f32[:, 0],
            triples,
        )

    def take_over(self, pages: Iterable[object], photographs: Iterable[object]) -> None:
        self.earlier = list(pages)

    def finish(self, go_on: GoOn = always) -> None:
        self.finished = True

    def ask(self, slots: Mapping[int, str]) -> None:
        self.slots = dict(slots)

    def reduce(self, load: Load) -> None:
        self.load = load

    def sight(self, camera: CameraModel, T_world_cam: F64) -> Sight:
        return new_sight(camera, T_world_cam)

    def tell_everything(self) -> None:
        pass

    def write_mesh(self, path: Path) -> Mesh:
        corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
        vertices = np.concatenate([corner + T[:3, 3].astype(np.float32) for _, T in self.trajectory])
        mesh = bare_mesh(vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3))
        write_ply(path, mesh)
        return mesh

    @property
    def warnings(self) -> Sequence[str]:
        return ()

    @property
    def falloff(self) -> Mapping[str, F64]:
        return {}

    @property
    def probability(self) -> F32:
        return np.empty(0, np.float32)

    def save(self, folder: Path) -> int:
        return (folder / "blocks.bin").write_bytes(b"blocks")


@pytest.fixture
def fake_pipeline(monkeypatch: pytest.MonkeyPatch) -> list[FakeMapper]:
    """Puts FakeMapper in the place of the pipeline; the list holds those made (the last one maps).

    Nothing is compiled for it beforehand.
    """
    made: list[FakeMapper] = []

    def make(config: object, odometry: Odometry, page_folder: Path, segmenter: object = None) -> FakeMapper:
        assert page_folder.is_dir()
        made.append(FakeMapper(odometry))
        return made[-1]

    monkeypatch.setattr("artemis_edge.runtime.compile_ahead", lambda *_: None)
    monkeypatch.setitem(sys.modules, "artemis_edge.pipeline", SimpleNamespace(Pipeline=make))
    return made


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """A KITTI odometry sequence of ten small scans between two walls, half a metre apart, and poses.tum."""
    sequence = tmp_path / "sequences" / "00"
    (sequence / "velodyne").mkdir(parents=True)
    rng = np.random.default_rng(5)
    for k in range(10):
        points = np.zeros((3000, 4), np.float32)
        points[:, :3] = rng.uniform([-20, -4, -1.7], [20, 4, 3], (3000, 3))
        points[:1000, 1], points[1000:2000, 1], points[2000:, 2] = -4.0, 4.0, -1.7
        points.tofile(sequence / "velodyne" / f"{k:06d}.bin")
    (sequence / "times.txt").write_text("".join(f"{0.1 * k:.6f}\n" for k in range(10)))
    lines = "".join(f"{0.1 * k:.6f} {0.5 * k:.6f} 0 0 0 0 0 1\n" for k in range(10))
    (tmp_path / "poses.tum").write_text(lines)
    return sequence
