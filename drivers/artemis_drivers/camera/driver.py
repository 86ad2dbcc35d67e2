"""The driver of one camera: a thread that takes photographs from a source, and looks for it again when it is gone."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

from artemis_drivers.base import DriverError, Health, State
from artemis_drivers.camera.files import FilesSource
from artemis_drivers.camera.frames import FRAME_SLOTS, FrameSource, frame_dtype, put
from artemis_drivers.camera.oak import OakSource
from artemis_drivers.camera.settings import CameraSettings, FilesSettings, OakSettings, most_bytes
from artemis_drivers.camera.shared import SharedSource
from artemis_drivers.device_thread import DeviceThread
from artemis_drivers.ring import Ring

_WAIT_S = 0.05
SILENT_S = 0.8  # without a photograph, while others say that triggers run


class Camera(DeviceThread):
    """Driver (base.Driver). ``frames`` is a ring of frame_dtype. ``last_sequence`` is -1 before the first one.

    A camera that waits for its trigger is not silent: ``triggers`` says whether triggers run.
    """

    def __init__(
        self,
        settings: CameraSettings,
        source: FrameSource | None = None,
        triggers: Callable[[], bool] = lambda: False,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        super().__init__(settings.name)
        self.settings = settings
        self.frames = Ring(frame_dtype(most_bytes(settings)), FRAME_SLOTS)
        self.last_sequence = -1
        self._source = source or source_of(settings)
        self._triggers, self._now = triggers, clock
        self._counts = {"unplugged": 0, "silent": 0, "missing": 0, "too_large": 0, "restarts": 0}

    def health(self) -> tuple[Health, ...]:
        """This camera."""
        (health,) = super().health()
        return (
            Health(
                health.name,
                health.state,
                health.message,
                health.counters,
                health.last_data_ns,
                self._source.identity(),
                health.applied,
                health.status,
            ),
        )

    def _run(self) -> None:
        failures = 0
        while not self._stop.is_set():
            try:
                self._become(State.CONNECTING)
                self._source.open()
            except (DriverError, OSError) as fault:
                self._source.close()
                self._become(State.SEARCHING, str(fault))
                self._pause(failures)
                failures += 1
                continue
            failures = 0
            try:
                self._become_running()
                self._read()
            except OSError as fault:
                self._counts["unplugged"] += 1
                self._become(State.SEARCHING, f"{self.settings.name} is gone ({fault}): plug it in again")
            finally:
                self._source.close()

    def _read(self) -> None:
        heard = time.monotonic()
        while not self._stop.is_set():
            frame = self._source.next(_WAIT_S)
            now = time.monotonic()
            if frame is None:
                if not self._triggers():
                    heard = now
                elif now - heard > SILENT_S and self._state == State.RUNNING:
                    self._counts["silent"] += 1
                    self._become(
                        State.SILENT,
                        f"{self.settings.name} gives no photographs: check its trigger cable (FSIN)",
                    )
                continue
            heard = now
            if self._state == State.SILENT:
                self._become_running()
            self._count(frame.sequence)
            self._last_data_ns = self._now()
            if not put(self.frames, frame, self._last_data_ns):
                self._counts["too_large"] += 1

    def _count(self, sequence: int) -> None:
        step = sequence - self.last_sequence
        if self.last_sequence >= 0 and step > 1:
            self._counts["missing"] += step - 1
        self._counts["restarts"] += self.last_sequence >= 0 and step < 0
        self.last_sequence = sequence

    def _counters(self) -> Mapping[str, int]:
        return {"frames": self.frames.published, **self._counts}

    def _status(self) -> Mapping[str, str]:
        if self.frames.published == 0:
            return {}
        row = (self.frames.published - 1) % self.frames.slots
        return {
            "exposure": f"{int(self.frames.field['exposure_ns'][row]) / 1e6:.2f} ms",
            "temperature": f"{float(self.frames.field['temperature_c'][row]):.0f} degC",
        }


def source_of(settings: CameraSettings) -> FrameSource:
    """The source that the settings describe."""
    if isinstance(settings, OakSettings):
        return OakSource(settings)
    if isinstance(settings, FilesSettings):
        return FilesSource(settings)
    return SharedSource(settings)
