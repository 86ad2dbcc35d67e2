"""A camera in another process: its photographs in a ring in a file of shared memory."""

from __future__ import annotations

import contextlib
import mmap
import os
import time
from pathlib import Path

from artemis_drivers.base import DriverError
from artemis_drivers.camera.frames import FRAME_SLOTS, CameraFrame, frame_dtype, put, take
from artemis_drivers.camera.settings import SharedSettings
from artemis_drivers.ring import Ring, RingReader

_POLL_S = 0.01


def _mapped(descriptor: int, most_bytes: int) -> Ring:
    dtype = frame_dtype(most_bytes)
    return Ring(dtype, FRAME_SLOTS, memoryview(mmap.mmap(descriptor, Ring.nbytes(dtype, FRAME_SLOTS))))


class SharedCamera:
    """The end that delivers: makes the file at ``path``, and removes it when it is unplugged."""

    def __init__(self, path: Path, most_bytes: int) -> None:
        self.path, self.most_bytes = path, most_bytes
        self._ring: Ring | None = None

    def plug(self) -> None:
        """Make the file, empty."""
        part = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        with part.open("w+b") as file:
            file.truncate(Ring.nbytes(frame_dtype(self.most_bytes), FRAME_SLOTS))
            self._ring = _mapped(file.fileno(), self.most_bytes)
        part.replace(self.path)

    def unplug(self) -> None:
        """The camera vanishes."""
        with contextlib.suppress(FileNotFoundError):
            self.path.unlink()
        self._ring = None

    def put(self, frame: CameraFrame) -> bool:
        """Deliver a photograph; False if nobody can see it."""
        return self._ring is not None and put(self._ring, frame, time.monotonic_ns())


class SharedSource:
    """FrameSource of such a file."""

    def __init__(self, settings: SharedSettings) -> None:
        self.settings = settings
        self._reader: RingReader | None = None
        self._file: tuple[int, int] = (0, 0)

    def open(self) -> None:
        """DriverError if it is not there."""
        path = Path(self.settings.path)
        try:
            with path.open("r+b") as file:
                status = os.fstat(file.fileno())
                self._file = (status.st_dev, status.st_ino)
                self._reader = RingReader(_mapped(file.fileno(), self.settings.most_bytes))
        except (OSError, ValueError) as fault:
            raise DriverError(
                f"{path} is not there or of another size ({fault}): start the camera's program"
            ) from fault

    def next(self, timeout_s: float) -> CameraFrame | None:
        """The next photograph; OSError when the file was taken away or made anew."""
        assert self._reader is not None
        end = time.monotonic() + timeout_s
        while not self._reader.waiting():
            if time.monotonic() > end:
                self._require_file()
                return None
            time.sleep(_POLL_S)
        number = max(self._reader.next, self._reader.ring.oldest())
        self._reader.next = number + 1
        found = take(self._reader.ring, number)
        return None if found is None else found[1]

    def close(self) -> None:
        """Give the memory back."""
        self._reader = None

    def identity(self) -> dict[str, str]:
        """Where it is."""
        return {"path": self.settings.path}

    def _require_file(self) -> None:
        try:
            status = Path(self.settings.path).stat()
        except OSError:
            raise OSError("its file was removed") from None
        if (status.st_dev, status.st_ino) != self._file:
            raise OSError("its file was made anew")
