"""A photograph as a camera delivers it, and the ring it goes into."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from artemis_drivers.ring import Ring

#: Encodings by their code in a ring, named as in ROS; the first two are files.
ENCODINGS = ("jpeg", "png", "mono8", "bgr8", "rgb8", "bayer_rggb8")
FRAME_SLOTS = 12


@dataclass(frozen=True, slots=True)
class CameraFrame:
    """``sequence`` as the camera counts, ``device_ns`` the end of the exposure by its own clock, -1 if it has none.

    ``data`` are rows of pixels or a file, by ``encoding``; ``gain`` is 1 for none.
    """

    sequence: int
    device_ns: int
    exposure_ns: int
    width: int
    height: int
    encoding: str
    data: bytes
    gain: float = 1.0
    temperature_c: float = float("nan")


class FrameSource(Protocol):
    """What delivers photographs. ``width`` and ``height`` of what follows are in each frame."""

    def open(self) -> None:
        """Connect; DriverError, one sentence, if that cannot work now."""
        ...

    def next(self, timeout_s: float) -> CameraFrame | None:
        """The next photograph, None if none came in time; OSError if the camera is gone."""
        ...

    def close(self) -> None:
        """Let go of the camera; may be called at any time."""
        ...

    def identity(self) -> dict[str, str]:
        """Serial number, model: what identifies the camera."""
        ...


def frame_dtype(most_bytes: int) -> np.dtype[np.void]:
    """Slots for photographs of up to so many bytes."""
    return np.dtype(
        [
            ("rx_ns", "i8"),
            ("sequence", "i8"),
            ("device_ns", "i8"),
            ("exposure_ns", "i8"),
            ("gain", "f4"),
            ("temperature_c", "f4"),
            ("width", "i4"),
            ("height", "i4"),
            ("encoding", "u1"),
            ("size", "i8"),
            ("data", "u1", (most_bytes,)),
        ]
    )


def room(ring: Ring) -> int:
    """Bytes a photograph may have."""
    return int(ring.dtype["data"].shape[0])


def put(ring: Ring, frame: CameraFrame, rx_ns: int) -> bool:
    """Publish a photograph received at host time ``rx_ns``; False if it is larger than a slot."""
    if len(frame.data) > room(ring):
        return False
    row = ring.claim(1) % ring.slots
    field = ring.field
    field["data"][row, : len(frame.data)] = np.frombuffer(frame.data, np.uint8)
    values = (rx_ns, frame.sequence, frame.device_ns, frame.exposure_ns, frame.gain, frame.temperature_c)
    for name, value in zip(
        ("rx_ns", "sequence", "device_ns", "exposure_ns", "gain", "temperature_c"), values, strict=True
    ):
        field[name][row] = value
    field["width"][row], field["height"][row], field["size"][row] = frame.width, frame.height, len(frame.data)
    field["encoding"][row] = ENCODINGS.index(frame.encoding)
    ring.publish(1)
    return True


def take(ring: Ring, number: int) -> tuple[int, CameraFrame] | None:
    """Host time of arrival and photograph ``number``; None if it was overwritten meanwhile."""
    row, f = number % ring.slots, ring.field
    frame = CameraFrame(
        int(f["sequence"][row]),
        int(f["device_ns"][row]),
        int(f["exposure_ns"][row]),
        int(f["width"][row]),
        int(f["height"][row]),
        ENCODINGS[int(f["encoding"][row]) % len(ENCODINGS)],
        f["data"][row, : int(f["size"][row])].tobytes(),
        float(f["gain"][row]),
        float(f["temperature_c"][row]),
    )
    rx_ns = int(f["rx_ns"][row])
    return (rx_ns, frame) if number >= ring.oldest() else None
