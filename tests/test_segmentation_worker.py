"""Masks beside the pipeline, the process with the network, and the photographs kept for later questions."""

import os
import signal
import time
from collections import deque
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from artemis_edge.cli import main
from artemis_edge.errors import InputError, RunError
from artemis_edge.export.mesh import bare_mesh
from artemis_edge.export.ply import write_ply
from artemis_edge.frames import F64, U8, CameraImage, CameraModel
from artemis_edge.segmentation.backend import Backend, Prompt, Segmentation, Status, Support
from artemis_edge.segmentation.engine import HereEngine, Job, ProcessEngine, Result, run_job
from artemis_edge.segmentation.keyframes import Apart, KeyframeStore, is_new, read_keyframes, segment_all
from artemis_edge.segmentation.knowledge import Knowledge
from artemis_edge.segmentation.live import LiveQuestions
from artemis_edge.segmentation.manifest import Kind, Manifest, Part
from artemis_edge.segmentation.opening import open_model
from artemis_edge.segmentation.registry import STORE_VARIABLE, Addition, Registry, file_hash, open_by_name
from artemis_edge.segmentation.resolve import understand
from artemis_edge.segmentation.worker import (
    Handed,
    LatestWins,
    Scheduled,
    as_logged,
    every,
    read_log,
    write_log,
)
from tests import networks

CAMERA = CameraModel(160, 120, 100.0, 100.0, 79.5, 59.5)
CAR = (Prompt(1, "car"),)


def png(pixels: U8) -> bytes:
    done, encoded = cv2.imencode(".png", pixels[:, :, ::-1])
    assert done
    return encoded.tobytes()


def image(stamp: float, name: str = "left", encoded: bytes | None = None) -> CameraImage:
    content = png(networks.photograph()) if encoded is None else encoded
    return CameraImage(name, int(stamp * 1e9), content, CAMERA, np.eye(4))


@pytest.fixture
def backend(tmp_path: Path) -> Backend:
    path = networks.semantic(tmp_path / "model.onnx")
    said = Manifest(
        name="colours", kind="semantic", file=path.name, sha256="0" * 64, licence="ours",
        classes=("background", *networks.CLASSES), input_size=(120, 160), stride=8,
    )  # fmt: skip
    return open_model(said, tmp_path)


class SlowEngine:
    """Is done when it is told to be; fails when it is told to."""

    def __init__(self, backend: Backend) -> None:
        self.backend = backend
        self.jobs: deque[Job] = deque()
        self.done = 0
        self.broken = False

    @property
    def busy(self) -> bool:
        return bool(self.jobs)

    def submit(self, job: Job) -> None:
        assert not self.jobs, "one job at a time"
        self.jobs.append(job)

    def fetch(self, wait: bool) -> Result | None:
        if self.broken:
            raise RunError("the segmentation process ended")
        if not self.jobs or not (wait or self.done):
            return None
        self.done = max(self.done - 1, 0)
        return run_job(self.backend, self.jobs.popleft())

    def close(self) -> None:
        self.jobs.clear()


# --- live


def test_the_latest_image_wins(backend: Backend) -> None:
    engine = SlowEngine(backend)
    worker: LatestWins[str] = LatestWins(engine, CAR)
    for k in range(5):
        assert worker.ready() == []
        worker.offer(image(0.1 * k), f"pose {k}")
    engine.done = 2
    (first,) = worker.ready()
    (second,) = worker.ready()
    assert [(seen.context, seen.stamp_ns) for seen in (first, second)] == [
        ("pose 0", 0),
        ("pose 4", 400_000_000),
    ]
    assert first.segmentation.answers[0].status is Status.MATCHED
    assert (worker.tally.offered, worker.tally.segmented, worker.tally.skipped) == (5, 2, 3)
    assert worker.log == [Handed(6, "left", 0), Handed(7, "left", 400_000_000)]


def test_cameras_take_turns(backend: Backend) -> None:
    engine = SlowEngine(backend)
    worker: LatestWins[None] = LatestWins(engine, CAR)
    names = []
    for k in range(6):
        for name in ("left", "right"):
            worker.offer(image(0.1 * k, name), None)
        engine.done = 1
        names += [seen.camera for seen in worker.ready()]
    assert names.count("left") == names.count("right") == 3


def test_a_bound_on_the_rate(backend: Backend) -> None:
    worker: LatestWins[None] = LatestWins(HereEngine(backend), CAR, most_hz=2.0)
    stamps = []
    for k in range(20):
        worker.offer(image(0.1 * k), None)
        stamps += [seen.stamp_ns / 1e9 for seen in worker.ready()]
    assert stamps == [0.0, 0.5, 1.0, 1.5]
    assert worker.tally.skipped == 16


def test_bad_photographs_are_counted(backend: Backend) -> None:
    worker: LatestWins[None] = LatestWins(HereEngine(backend), CAR)
    for content in (b"", b"no photograph"):
        worker.offer(image(0.0, encoded=content), None)
        assert worker.ready() == []
    assert (worker.tally.faulty, worker.tally.first_fault) == (2, "the photograph cannot be decoded")


def test_a_photograph_that_the_network_fails_on(backend: Backend) -> None:
    class Failing:
        name, classes = "failing", ()

        def support(self, text: str) -> Support:
            return backend.support(text)

        def segment(self, image: U8, prompts: Sequence[Prompt]) -> Segmentation:
            raise IndexError("beyond")

    result = run_job(Failing(), Job(png(networks.photograph()), CAR))
    assert result.segmentation is None
    assert result.fault == "the network failed on the photograph (IndexError: beyond)"


def test_a_broken_engine_does_not_stop_the_map(backend: Backend) -> None:
    engine = SlowEngine(backend)
    worker: LatestWins[None] = LatestWins(engine, CAR)
    worker.offer(image(0.0), None)
    engine.broken = True
    assert worker.ready() == []
    assert worker.fault == "the segmentation process ended"
    worker.offer(image(0.1), None)
    assert worker.ready() == []
    assert (worker.tally.offered, worker.tally.skipped) == (2, 2)


def test_without_prompts_nothing_is_segmented(backend: Backend) -> None:
    worker: LatestWins[None] = LatestWins(SlowEngine(backend), ())
    worker.offer(image(0.0), None)
    assert not worker.engine.busy


def test_questions_come_and_go(backend: Backend) -> None:
    engine = SlowEngine(backend)
    live: LiveQuestions[str] = LiveQuestions(backend, LatestWins(engine, ()))
    live.offer(image(0.0), "nothing is asked yet")
    assert live.add("red car").classes == ("car",)
    assert live.add("person next to the bench").status is Status.MATCHED
    assert live.add("giraffe").status is Status.UNSUPPORTED
    assert live.names == {1: "car", 2: "person", 3: "bench"}
    live.offer(image(0.1), "first")
    assert live.remove("red car") == [1]
    assert live.remove("giraffe") == []
    assert live.add("benches").classes == ("bench",)
    engine.done = 1
    (seen,) = live.ready()  # it was made when the car was still asked for
    assert seen.segmentation.dense.slots == (0, 2, 3)
    expected = backend.segment(networks.photograph(), seen.prompts).dense
    np.testing.assert_array_equal(seen.segmentation.dense.score[:, :, 1], expected.score[:, :, 2])
    live.offer(image(0.2), "second")
    engine.done = 1
    (seen,) = live.ready()
    assert [prompt.slot for prompt in seen.prompts] == [2, 3]
    assert live.remove("person next to the bench") == [2]  # the bench is asked for still
    with pytest.raises(InputError, match=r"is not among the questions asked \('benches'\)"):
        live.remove("red car")


def test_what_a_model_knows_is_told_by_its_manifest(backend: Backend, tmp_path: Path) -> None:
    def said(kind: Kind, *classes: str, **parts: Part) -> Knowledge:
        return Knowledge(
            Manifest(name="m", kind=kind, file="f", sha256="0" * 64, licence="", classes=classes, parts=parts)
        )

    closed = said("semantic", "background", *networks.CLASSES)
    for word in (*networks.CLASSES, "giraffe", "background", ""):
        assert closed.support(word).status is backend.support(word).status
    table = Part(file="t.npy", sha256="0" * 64)
    assert said("openvocab-seg", "car", embeddings=table).support("giraffe").status is Status.UNSUPPORTED
    assert said("openvocab-seg").support("giraffe").status is Status.MATCHED
    assert said("fastsam-clip").support("giraffe").status is Status.MATCHED
    assert said("attribute").support("car").status is Status.APPROXIMATE
    assert understand("vehicles", said("yolo-seg", "motorbike", "lorry")).classes == ("truck", "motorcycle")


# --- repeatable


def handed_over(
    worker: Scheduled[int], engine: SlowEngine | None, patience: Sequence[int]
) -> list[tuple[int, int]]:
    """(turn, context) of all masks of 12 frames with an image each; the engine is done as ``patience`` says.

    A context is made when the image is offered, and only where a mask will come back with it.
    """
    out, made = [], []

    def context() -> int:
        made.append(turn)
        return turn

    for turn in range(1, 13):
        out += [(turn, seen.context) for seen in worker.ready()]
        worker.offer(image(0.1 * turn), context)
        if engine is not None:
            engine.done = patience[turn % len(patience)]
    out += [(13, seen.context) for seen in worker.drain()]
    assert made == [offered for _, offered in out]
    return out


def test_masks_come_when_the_rule_says_however_slow_the_engine(backend: Backend) -> None:
    expected = [(5, 3), (8, 6), (11, 9), (13, 12)]
    for patience in ([0], [1], [0, 1, 0, 0, 2]):
        engine = SlowEngine(backend)
        worker: Scheduled[int] = Scheduled(engine, CAR, every(3, 2))
        assert handed_over(worker, engine, patience) == expected
        assert (worker.tally.offered, worker.tally.segmented, worker.tally.skipped) == (12, 4, 8)
    here: Scheduled[int] = Scheduled(HereEngine(backend), CAR, every(3, 2))
    assert handed_over(here, None, []) == expected


def test_a_live_run_can_be_repeated_by_its_log(backend: Backend, tmp_path: Path) -> None:
    engine = SlowEngine(backend)
    live: LatestWins[int] = LatestWins(engine, CAR)
    first = []
    for turn in range(1, 13):
        first += [(turn, seen.context) for seen in live.ready()]
        live.offer(image(0.1 * turn), turn)
        engine.done = turn % 3 == 0
    write_log(tmp_path / "masks.json", live.log)
    again: Scheduled[int] = Scheduled(HereEngine(backend), CAR, as_logged(read_log(tmp_path / "masks.json")))
    assert handed_over(again, None, []) == first
    assert len(first) > 2


def test_a_log_that_is_none(tmp_path: Path) -> None:
    for content in (b"{", b"[]", b'{"masks": [1]}', b"\xff"):
        (tmp_path / "log").write_bytes(content)
        with pytest.raises(InputError, match="is not a log of masks"):
            read_log(tmp_path / "log")
    with pytest.raises(InputError, match="cannot read"):
        read_log(tmp_path / "gone")


# --- the process


@pytest.fixture
def registered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv(STORE_VARIABLE, str(tmp_path / "store"))
    path = networks.semantic(tmp_path / "colours.onnx")
    classes = ("background", *networks.CLASSES)
    Registry().add(Addition(path, {"model": file_hash(path)}, classes=classes, input_size=(128, 160)))
    return "colours"


def test_a_process_of_its_own(registered: str) -> None:
    engine = ProcessEngine(partial(open_by_name, registered))
    try:
        worker: LatestWins[int] = LatestWins(engine, CAR)
        worker.offer(image(0.0), 7)
        assert worker.ready() == []  # it is still starting, and nobody waits
        engine.wait_until_ready()
        worker.ready()
        assert engine.busy
        deadline = time.monotonic() + 30
        found = worker.ready()
        while not found and time.monotonic() < deadline:
            time.sleep(0.01)
            found = worker.ready()
        assert found[0].context == 7
        expected = open_by_name(registered).segment(networks.photograph(), CAR)
        np.testing.assert_array_equal(found[0].segmentation.dense.score, expected.dense.score)
        worker.offer(image(0.1), 8)
        os.kill(engine.process_id, signal.SIGKILL)
        while not worker.fault and time.monotonic() < deadline:
            time.sleep(0.01)
            assert worker.ready() == []
        assert "the segmentation process ended" in worker.fault
        with pytest.raises(RunError, match="exit code -9"):
            engine.fetch(wait=True)  # and never waits for what cannot come
    finally:
        engine.close()


def test_a_process_that_cannot_open_its_model(registered: str) -> None:
    engine = ProcessEngine(partial(open_by_name, "gone"))
    try:
        with pytest.raises(RunError, match="no model named 'gone'"):
            engine.wait_until_ready()
    finally:
        engine.close()


# --- keyframes


def pose(x: float, yaw_deg: float = 0.0) -> F64:
    """Camera at (x, 0, 0), looking along a horizontal direction."""
    a = np.radians(yaw_deg)
    T = np.eye(4)
    T[:3, 2] = np.cos(a), np.sin(a), 0.0
    T[:3, 0] = np.sin(a), -np.cos(a), 0.0
    T[:3, 1] = 0.0, 0.0, -1.0
    T[0, 3] = x
    return T


APART = Apart(0.5, np.radians(15))


def test_what_is_new() -> None:
    assert is_new([], pose(0), APART)
    assert not is_new([pose(0)], pose(0.3), APART)
    assert is_new([pose(0)], pose(0.6), APART)
    assert is_new([pose(0)], pose(0, 20), APART)
    assert is_new([pose(0)], pose(0.3, 10), APART)
    assert not is_new([pose(0), pose(5, 90)], pose(5.1, 88), APART)  # a place seen before


def test_keyframes_survive_and_are_read(tmp_path: Path, backend: Backend) -> None:
    store = KeyframeStore(tmp_path / "scratch", APART, 10_000_000)
    kept = [store.offer(image(k), pose(0.2 * k)) for k in range(10)]
    assert kept == [k % 3 == 0 for k in range(10)]
    assert store.offer(image(3.5, "right"), pose(0.0))
    assert not store.offer(image(11, encoded=b""), pose(50))
    assert not store.offer(image(11), pose(np.nan))
    store.save(tmp_path / "map")
    found = read_keyframes(tmp_path / "map")
    assert [(item.camera, item.stamp_ns // 10**9) for item in found] == [
        ("left", 0), ("left", 3), ("right", 3), ("left", 6), ("left", 9),
    ]  # fmt: skip
    np.testing.assert_allclose(found[1].T_world_cam, pose(0.6), atol=1e-12)
    assert found[0].model == CAMERA
    said: list[tuple[int, int]] = []
    faults: list[str] = []
    found[2].file.write_bytes(b"damaged")
    found[3].file.unlink()
    seen = list(
        segment_all(
            found, backend, CAR, lambda done, total, note="": said.append((done, total)), faults.append
        )
    )
    assert [item.stamp_ns // 10**9 for item, _ in seen] == [0, 3, 9]
    assert all(result.answers[0].status is Status.MATCHED for _, result in seen)
    assert said[-1] == (5, 5)
    assert len(faults) == 2


def test_the_budget_is_kept(tmp_path: Path) -> None:
    content = png(networks.photograph())
    store = KeyframeStore(tmp_path / "scratch", APART, 5 * len(content))
    for k in range(100):
        store.offer(image(k, encoded=content), pose(0.6 * k))
        assert store.size <= 5 * len(content)
        assert sum(path.stat().st_size for path in (tmp_path / "scratch").iterdir()) == store.size
    places = [kept.T_world_cam[0, 3] for kept in read_after(store, tmp_path)]
    assert 2 <= len(places) <= 5
    assert max(places) > 30  # the end of the walk is there too
    small = KeyframeStore(tmp_path / "small", APART, 10)
    assert not small.offer(image(0, encoded=content), pose(0))
    assert (len(small), list((tmp_path / "small").iterdir())) == (0, [])


def read_after(store: KeyframeStore, tmp_path: Path) -> list:
    store.save(tmp_path / "map")
    return read_keyframes(tmp_path / "map")


def test_the_same_photographs_are_kept_again(tmp_path: Path) -> None:
    names = []
    for folder in ("a", "b"):
        store = KeyframeStore(tmp_path / folder, APART, 4 * len(png(networks.photograph())))
        for k in range(30):
            store.offer(image(k), pose(0.4 * k, 3.0 * k))
        names.append(sorted(path.name for path in (tmp_path / folder).iterdir()))
    assert names[0] == names[1]


def test_maps_without_photographs(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has no photographs to look at"):
        read_keyframes(tmp_path)
    (tmp_path / "keyframes").mkdir()
    for content in (
        "{",
        '{"photos": [{}]}',
        '{"photos": [{"file": "x", "distortion": [1], "T_cam_world": []}]}',
    ):
        (tmp_path / "keyframes/index.json").write_text(content)
        with pytest.raises(InputError, match="map the recording again"):
            read_keyframes(tmp_path)


def test_an_index_that_names_no_photographs_is_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    index = tmp_path / "map" / "keyframes" / "index.json"
    index.parent.mkdir(parents=True)
    index.write_text('{"photos": []}')
    write_ply(tmp_path / "mesh.ply", bare_mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32)))
    assert main(["ask", str(tmp_path), "car"]) == 2
    assert "has no photographs to look at" in capsys.readouterr().err
    store = KeyframeStore(tmp_path / "scratch", APART, 10_000_000)
    store.take_over(tmp_path / "map")  # nothing to begin with is nothing to complain about
    assert len(store) == 0


def test_photographs_kept_by_others_are_used(tmp_path: Path) -> None:
    """An index in the plain form of PHOTOS.json, without sizes."""
    (tmp_path / "p.png").write_bytes(png(networks.photograph()))
    entry = {"file": "p.png", "fx": 100, "fy": 100, "cx": 79.5, "cy": 59.5, "distortion": [0] * 5,
             "T_cam_world": np.eye(4).tolist()}  # fmt: skip
    import json

    (tmp_path / "images.json").write_text(json.dumps({"photos": [entry]}))
    (found,) = read_keyframes(tmp_path)
    assert (found.model.width, found.model.height, found.camera) == (160, 120, "p")
