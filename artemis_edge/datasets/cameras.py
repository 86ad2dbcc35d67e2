"""Cameras of a bag: which CameraInfo belongs to which image topic, and images as encoded files."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from artemis_edge.frames import CameraModel
from artemis_edge.session.cdr import CdrError
from artemis_edge.session.messages import CameraExposure, CameraInfo, CompressedImage, Image

# Lossless, and fast to write rather than small: the file lives as long as its frame.
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]
_LONGEST_S = 10.0
# Image encodings: channels, and the OpenCV conversion to BGR or grey (None: as they are).
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "mono8": (1, None),
    "8UC1": (1, None),
    "bgr8": (3, None),
    "8UC3": (3, None),
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    # OpenCV names a Bayer pattern by its second row and column.
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2BGR),
}


def info_topics(image_topic: str) -> tuple[str, ...]:
    """Where the CameraInfo of an image topic is expected, the likeliest first."""
    base = image_topic.removesuffix("/compressed")
    folder = base.rpartition("/")[0]
    return (f"{folder}/camera_info", f"{base}/camera_info", f"{folder.rpartition('/')[0]}/camera_info")


def exposure_s(message: CameraExposure) -> float:
    """Seconds; 0, unknown, for what no exposure can be."""
    return message.exposure_s if 0 < message.exposure_s < _LONGEST_S else 0.0


def camera_model(info: CameraInfo, rectified: bool) -> CameraModel | None:
    """The pinhole model with Brown-Conrady distortion, None for a lens that it cannot describe."""
    K = info.p.reshape(3, 4)[:, :3] if rectified else info.k.reshape(3, 3)
    d = np.zeros(0) if rectified else np.asarray(info.d, np.float64)
    if info.distortion_model not in ("plumb_bob", "rational_polynomial", "") or (d[5:] != 0.0).any():
        return None
    usable = np.isfinite(K).all() and np.isfinite(d).all() and K[0, 0] > 0.0 and K[1, 1] > 0.0
    if not usable or info.width == 0 or info.height == 0:
        return None
    k1, k2, p1, p2, k3 = (float(v) for v in np.pad(d[:5], (0, 5 - len(d[:5]))))
    fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    return CameraModel(int(info.width), int(info.height), fx, fy, cx, cy, (k1, k2, p1, p2, k3))


def encoded_image(message: CompressedImage | Image) -> bytes:
    """The image as a jpeg or png file; CdrError for an encoding that is not known or data too short."""
    if isinstance(message, CompressedImage):
        return bytes(message.data)
    done, data = cv2.imencode(".png", _pixels(message), _PNG)
    if not done:
        raise CdrError("an image cannot be encoded")
    return bytes(data)


def _pixels(message: Image) -> NDArray[np.uint8]:
    if message.encoding not in _ENCODINGS:
        raise CdrError(f"an image has the encoding '{message.encoding[:40]}'")
    channels, conversion = _ENCODINGS[message.encoding]
    row = message.width * channels
    needed = (message.height - 1) * message.step + row
    if row == 0 or message.height == 0 or message.step < row or len(message.data) < needed:
        raise CdrError(
            f"an image of {message.width} x {message.height} has {len(message.data)} bytes of data"
        )
    shape, strides = (message.height, message.width, channels), (message.step, channels, 1)
    pixels = np.ascontiguousarray(np.ndarray(shape, np.uint8, message.data, strides=strides))
    return pixels if conversion is None else cv2.cvtColor(pixels, conversion).astype(np.uint8, copy=False)
