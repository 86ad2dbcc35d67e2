"""Photographs of a folder or a video file, at a steady rate."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import cv2

from artemis_drivers.base import DriverError
from artemis_drivers.camera.frames import CameraFrame
from artemis_drivers.camera.settings import FilesSettings

_FILES = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png"}


class FilesSource:
    """FrameSource of files; ``device_ns`` is the time at which a photograph was due."""

    def __init__(self, settings: FilesSettings) -> None:
        self.settings = settings
        self._pictures: Iterator[tuple[str, int, int, bytes]] = iter(())
        self._sequence = 0
        self._due_ns = 0

    def open(self) -> None:
        """DriverError if there are no pictures."""
        path = Path(self.settings.path)
        if not path.exists():
            raise DriverError(f"{path} is not there: correct the camera's path")
        self._pictures = self._folder(path) if path.is_dir() else self._video(path)
        self._sequence, self._due_ns = 0, time.monotonic_ns()

    def next(self, timeout_s: float) -> CameraFrame | None:
        """The next picture when it is due; OSError at the end."""
        wait = (self._due_ns - time.monotonic_ns()) * 1e-9
        time.sleep(min(max(wait, 0.0), timeout_s))
        if wait > timeout_s:
            return None
        try:
            encoding, width, height, data = next(self._pictures)
        except StopIteration:
            raise OSError("no more pictures") from None
        exposure = self.settings.exposure_us * 1000
        frame = CameraFrame(self._sequence, self._due_ns, exposure, width, height, encoding, data)
        self._sequence += 1
        self._due_ns += round(1e9 / self.settings.rate_hz)
        return frame

    def close(self) -> None:
        """Nothing is held open between pictures but a video."""
        self._pictures = iter(())

    def identity(self) -> dict[str, str]:
        """Where the pictures are."""
        return {"path": self.settings.path}

    def _folder(self, path: Path) -> Iterator[tuple[str, int, int, bytes]]:
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in _FILES)
        if not files:
            raise DriverError(f"{path} holds no .jpg or .png: give a folder with pictures")
        return self._repeat_files(files)

    def _repeat_files(self, files: list[Path]) -> Iterator[tuple[str, int, int, bytes]]:
        while True:
            for file in files:
                picture = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
                if picture is not None:
                    height, width = picture.shape[:2]
                    yield _FILES[file.suffix.lower()], width, height, file.read_bytes()
            if not self.settings.repeat:
                return

    def _video(self, path: Path) -> Iterator[tuple[str, int, int, bytes]]:
        while True:
            video = cv2.VideoCapture(str(path))
            try:
                if not video.isOpened():
                    raise DriverError(f"{path} is no video that can be read: give another file or a folder")
                while True:
                    read, picture = video.read()
                    if not read:
                        break
                    height, width = picture.shape[:2]
                    quality = [cv2.IMWRITE_JPEG_QUALITY, self.settings.jpeg_quality]
                    yield "jpeg", width, height, cv2.imencode(".jpg", picture, quality)[1].tobytes()
            finally:
                video.release()
            if not self.settings.repeat:
                return
