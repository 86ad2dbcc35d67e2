"""Cameras: files, shared memory, the message path of depthai; losses are counted, what goes comes back."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest
from artemis_drivers.base import DriverError, State
from artemis_drivers.camera import oak
from artemis_drivers.camera.driver import Camera
from artemis_drivers.camera.files import FilesSource
from artemis_drivers.camera.frames import CameraFrame, frame_dtype, put, take
from artemis_drivers.camera.settings import FilesSettings, OakSettings, SharedSettings, most_bytes
from artemis_drivers.camera.shared import SharedCamera, SharedSource
from artemis_drivers.ring import Ring

from tests.waiting import until


def _frame(sequence: int, data: bytes = b"x" * 100, encoding: str = "jpeg") -> CameraFrame:
    return CameraFrame(sequence, sequence * 1000, 4_000_000, 16, 12, encoding, data, 2.0, 40.0)


def test_a_ring_gives_back_what_was_put() -> None:
    ring = Ring(frame_dtype(200), 3)
    for k in range(5):
        assert put(ring, _frame(k, bytes([k]) * (10 * k)), 77 + k)
    assert take(ring, 4) == (81, _frame(4, bytes([4]) * 40))
    assert take(ring, 1) is None, "overwritten"
    assert not put(ring, _frame(9, bytes(201)), 0)
    assert ring.published == 5


class _Source:
    """A camera made of a list: frames, None for a pause, an exception."""

    def __init__(self, script: list[CameraFrame | Exception | None]) -> None:
        self.script, self.opened = script, 0

    def open(self) -> None:
        self.opened += 1

    def next(self, timeout_s: float) -> CameraFrame | None:
        if not self.script:
            return None
        item = self.script.pop(0)
        if isinstance(item, Exception):
            raise item
        return item

    def close(self) -> None:
        pass

    def identity(self) -> dict[str, str]:
        return {"serial": "7"}


@pytest.fixture
def running() -> Iterator[list[Camera]]:
    cameras: list[Camera] = []
    yield cameras
    for camera in cameras:
        camera.stop()


def test_losses_and_restarts_are_counted(running: list[Camera]) -> None:
    frames = [_frame(0), _frame(1), _frame(4), OSError("cable"), _frame(0), _frame(1, bytes(3_000_000))]
    source = _Source([*frames])
    camera = Camera(SharedSettings("unused"), source)
    running.append(camera)
    camera.start()
    assert until(lambda: not source.script)
    assert until(lambda: camera.health()[0].counters["too_large"] == 1)
    (health,) = camera.health()
    assert health.state == State.RUNNING and health.identity == {"serial": "7"} and source.opened == 2
    assert {k: v for k, v in health.counters.items() if v} == {
        "frames": 4,
        "missing": 2,
        "unplugged": 1,
        "restarts": 1,
        "too_large": 1,
    }
    assert camera.last_sequence == 1


def test_a_camera_is_silent_only_while_triggers_run(
    running: list[Camera], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("artemis_drivers.camera.driver.SILENT_S", 0.02)
    triggers = False
    source = _Source([_frame(0)])
    camera = Camera(SharedSettings("unused"), source, lambda: triggers)
    running.append(camera)
    camera.start()
    assert until(lambda: camera.frames.published == 1)
    assert camera.health()[0].state == State.RUNNING
    triggers = True
    assert until(lambda: camera.health()[0].state == State.SILENT)
    assert "FSIN" in camera.health()[0].message
    source.script.append(_frame(1))
    assert until(lambda: camera.health()[0].state == State.RUNNING)


def test_a_shared_camera_goes_and_comes_back(tmp_path: Path, running: list[Camera]) -> None:
    settings = SharedSettings(str(tmp_path / "cam"), most_bytes=4096)
    device, camera = SharedCamera(tmp_path / "cam", 4096), Camera(settings)
    running.append(camera)
    assert not device.put(_frame(0))
    camera.start()
    assert until(lambda: "is not there" in camera.health()[0].message)
    for life in range(2):
        device.plug()
        assert until(lambda: camera.health()[0].state == State.RUNNING)
        assert device.put(_frame(life))
        assert until(lambda count=life + 1: camera.frames.published == count)
        device.unplug()
        assert until(lambda: camera.health()[0].state == State.SEARCHING)
    assert take(camera.frames, 1)[1] == _frame(1)  # type: ignore[index]
    with pytest.raises(DriverError, match="is not there"):
        SharedSource(settings).open()


def test_files_of_a_folder_and_of_a_video(tmp_path: Path) -> None:
    picture = np.full((12, 16, 3), 200, np.uint8)
    for name in ("b.png", "a.jpg", "notes.txt"):
        if name.endswith("txt"):
            (tmp_path / name).write_text("no picture")
        else:
            cv2.imwrite(str(tmp_path / name), picture)
    source = FilesSource(FilesSettings(str(tmp_path), rate_hz=100.0, repeat=False, exposure_us=5))
    source.open()
    first, second = source.next(1.0), source.next(1.0)
    assert first is not None and second is not None
    assert [(f.sequence, f.encoding, f.width, f.height, f.exposure_ns) for f in (first, second)] == [
        (0, "jpeg", 16, 12, 5000),
        (1, "png", 16, 12, 5000),
    ]
    assert second.device_ns - first.device_ns == 10_000_000
    assert first.data == (tmp_path / "a.jpg").read_bytes()
    with pytest.raises(OSError, match="no more pictures"):
        source.next(1.0)
    with pytest.raises(DriverError, match="is not there"):
        FilesSource(FilesSettings(str(tmp_path / "nothing"))).open()
    video = tmp_path / "v.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (16, 12))
    for _ in range(2):
        writer.write(picture)
    writer.release()
    source = FilesSource(FilesSettings(str(video), rate_hz=100.0))
    source.open()
    frames = [source.next(1.0) for _ in range(3)]
    assert [f.sequence for f in frames if f is not None] == [0, 1, 2], "a video begins again"
    assert cv2.imdecode(np.frombuffer(frames[0].data, np.uint8), 1).shape == (12, 16, 3)  # type: ignore[union-attr]


def test_without_the_library_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "depthai", None)
    with pytest.raises(DriverError, match="oak"):
        oak.OakSource(OakSettings()).open()
    assert most_bytes(OakSettings(width=100, height=10)) == 3000
    assert oak.nanoseconds(timedelta(days=1, seconds=2, microseconds=3)) == 86_402_000_003_000


def test_the_message_path_of_depthai() -> None:
    """Frames through a pipeline without a device arrive as they were sent: numbers, times, exposure, pixels."""
    dai = pytest.importorskip("depthai")
    grey = np.arange(12 * 16, dtype=np.uint8).reshape(12, 16)

    class Camera(dai.node.ThreadedHostNode):  # type: ignore[misc, name-defined]
        def __init__(self) -> None:
            super().__init__()
            self.output = self.createOutput()

        def run(self) -> None:
            for k in range(20):
                frame = dai.ImgFrame()
                frame.setCvFrame(grey + k, dai.ImgFrame.Type.GRAY8)
                frame.setSequenceNum(k)
                frame.setTimestampDevice(timedelta(seconds=5, microseconds=1000 * k))
                self.output.send(frame)

    with dai.Pipeline(createImplicitDevice=False) as pipeline:
        queue = pipeline.create(Camera).output.createOutputQueue(maxSize=32, blocking=True)
        pipeline.start()
        source = oak.OakSource(OakSettings(jpeg_quality=90))
        source._pipeline, source._queue = pipeline, queue
        frames = [frame for frame in (source.next(1.0) for _ in range(20)) if frame is not None]
        source.close()
    assert [frame.sequence for frame in frames] == list(range(20))
    assert [frame.device_ns for frame in frames] == [5_000_000_000 + 1_000_000 * k for k in range(20)]
    picture = cv2.imdecode(np.frombuffer(frames[3].data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert frames[3].encoding == "jpeg" and (frames[3].width, frames[3].height) == (16, 12)
    assert np.abs(picture.astype(int) - (grey + 3)).mean() < 8
