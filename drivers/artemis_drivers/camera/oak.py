"""Hardware-triggered OAK cameras by depthai v3. The library is an extra and loaded only when it is used.

The sensor starts a frame at the rising edge of FSIN; depthai stamps a frame at the end of its exposure (measured with
depthai 3.12 on a message: START is the stamp less the exposure). Not tried on a device yet: the message path is, in a
pipeline without one.
"""

from __future__ import annotations

import contextlib
from datetime import timedelta
from typing import Any

import cv2
import numpy as np

from artemis_drivers.base import DriverError
from artemis_drivers.camera.frames import CameraFrame
from artemis_drivers.camera.settings import OakSettings

_QUEUE = 16  # frames; the library's own default drops silently when the reader is late
_ISO_OF_GAIN_1 = 100.0
_TIE_GPIO = 38


def load() -> Any:
    """The library; DriverError if it is not installed."""
    try:
        import depthai
    except ImportError as fault:
        raise DriverError("OAK cameras need the extra: pip install 'artemis-edge[oak]'") from fault
    return depthai


def to_frame(message: Any, jpeg_quality: int = 0) -> CameraFrame:
    """The photograph in an ImgFrame; OSError for a type of image that is not handled."""
    dai = load()
    types = {
        dai.ImgFrame.Type.GRAY8: "mono8",
        dai.ImgFrame.Type.BGR888i: "bgr8",
        dai.ImgFrame.Type.RGB888i: "rgb8",
    }
    kind = message.getType()
    if kind == dai.ImgFrame.Type.NV12:
        pixels, encoding = message.getCvFrame(), "bgr8"
    elif kind in types:
        pixels, encoding = message.getFrame(), types[kind]
    else:
        raise OSError(f"it sends images of type {kind}")
    height, width = pixels.shape[:2]
    data = np.ascontiguousarray(pixels).tobytes()
    if jpeg_quality:
        colours = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR) if encoding == "rgb8" else pixels
        data = cv2.imencode(".jpg", colours, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])[1].tobytes()
        encoding = "jpeg"
    temperature = message.getSensorTemperature()
    return CameraFrame(
        int(message.getSequenceNum()),
        nanoseconds(message.getTimestampDevice()),
        nanoseconds(message.getExposureTime()),
        width,
        height,
        encoding,
        data,
        message.getSensitivity() / _ISO_OF_GAIN_1,
        float("nan") if temperature is None else float(temperature),
    )


def nanoseconds(time: timedelta) -> int:
    """A timedelta, exactly."""
    return ((time.days * 86_400 + time.seconds) * 1_000_000 + time.microseconds) * 1000


class OakSource:
    """FrameSource of one camera of an OAK."""

    def __init__(self, settings: OakSettings) -> None:
        self.settings = settings
        self._pipeline: Any = None
        self._queue: Any = None
        self._identity: dict[str, str] = {}

    def open(self) -> None:
        """Connect, configure, start; DriverError if there is no such camera."""
        dai, s = load(), self.settings
        try:
            config = board_config(dai, s)
            device = dai.Device(config, dai.DeviceInfo(s.device)) if s.device else dai.Device(config)
            self._identity = {"serial": str(device.getDeviceId()), "model": str(device.getDeviceName())}
            self._pipeline = dai.Pipeline(device)
            socket = getattr(dai.CameraBoardSocket, s.socket)
            camera = self._pipeline.create(dai.node.Camera).build(socket, (s.width, s.height), s.fps)
            self._configure(dai, camera.initialControl)
            output = camera.requestOutput((s.width, s.height), type=dai.ImgFrame.Type.NV12)
            self._queue = output.createOutputQueue(maxSize=_QUEUE, blocking=True)
            self._pipeline.start()
        except RuntimeError as fault:
            what = " ".join(str(fault).split())[:160]
            raise DriverError(f"{s.name}: no OAK camera ({what}): check its USB cable and power") from fault

    def next(self, timeout_s: float) -> CameraFrame | None:
        """The next photograph; OSError if the connection broke."""
        try:
            message = self._queue.get(timedelta(seconds=timeout_s))
        except RuntimeError as fault:
            raise OSError(" ".join(str(fault).split())[:160]) from fault
        return None if message is None else to_frame(message, self.settings.jpeg_quality)

    def close(self) -> None:
        """Let go of the device."""
        pipeline, self._pipeline, self._queue = self._pipeline, None, None
        if pipeline is not None:
            with contextlib.suppress(RuntimeError):
                pipeline.stop()

    def identity(self) -> dict[str, str]:
        """Serial number and model."""
        return self._identity

    def _configure(self, dai: Any, control: Any) -> None:
        s = self.settings
        control.setManualExposure(timedelta(microseconds=s.exposure_us), s.iso)
        if s.trigger == "snapshot":
            control.setExternalTrigger(1, 0)
        else:
            control.setFrameSyncMode(dai.CameraControl.FrameSyncMode.INPUT)


def board_config(dai: Any, settings: OakSettings) -> Any:
    """The board with its two groups of FSIN pins joined, where that is asked for.

    OAK-FFC-4P from R6 on: GPIO 38 selects; earlier boards: GPIO 6 (public scripts; not tried on a board). Left alone
    unless asked for: the board tells its revision only once it runs.
    """
    config = dai.Device.Config()
    if settings.tie_groups:
        gpio = dai.BoardConfig.GPIO
        config.board.gpio[_TIE_GPIO] = gpio(gpio.OUTPUT, gpio.Level.HIGH)
    return config
