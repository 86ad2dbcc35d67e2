"""The reference depth of a view as a file: what the map knew of it when its photograph was taken.

A PNG of 16 bits and one channel: four pictures of the depth map's cells one below the other. The first is the logarithm
of the depth, 0 where nothing is known; the others are, relative to the depth, the plane's inverse depth at the cell's
centre less 1, and its change over a cell to the right and down.
"""

from __future__ import annotations

import struct

import cv2
import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.frames import F32, F64
from artemis_edge.sight import DEPTH, DOWN, INVERSE, NEAR_M, RIGHT, cell_px, empty_depth
from artemis_edge.trajectory import FARTHEST_M

# Relative to the depth: a fifteenth of sigma_geom, which weighs depths
_STEP = 0.002
_ZERO = 32768  # of numbers that may be negative
_MOST = 65535
# Smaller by a sixth than with 1; 6 saves another eighth and takes twice the time
_EFFORT = 3
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
# How a PNG begins: signature, length and name of the first chunk, width and height
_HEADER = struct.Struct(">8s4x4sII")


def encode_depth(depth: F32, lens: F64) -> bytes:
    """The file of a depth map float32 (h, w, 4) of a ``Sight`` with that ``lens``."""
    known = depth[:, :, DEPTH] < np.inf
    level = np.log(np.where(known, depth[:, :, DEPTH], NEAR_M) / NEAR_M) / _STEP
    level = np.where(known, np.clip(np.rint(level) + 1, 1, _MOST), 0)
    z = np.where(known, _depth_of(level), 0.0)  # of cells that are not known nothing is told
    planes = (z * depth[:, :, INVERSE] - known, *(z * depth[:, :, k] * cell_px(lens) for k in (RIGHT, DOWN)))
    told = [np.clip(np.rint(plane / _STEP) + _ZERO, 0, _MOST) for plane in planes]
    picture = np.vstack([level, *told]).astype(np.uint16)
    return bytes(cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, _EFFORT])[1])


def decode_depth(content: bytes, lens: F64) -> F32:
    """The depth map of a file for a ``Sight`` with that ``lens``; raises InputError where it is none."""
    depth = empty_depth(lens)
    high, wide, count = depth.shape
    picture = _decoded(content, (count * high, wide))
    if picture is None:
        raise InputError(f"is not a depth map of {wide} x {high} cells")
    level, *told = np.split(picture, count)
    if _depth_of(level.max()) > FARTHEST_M:
        raise InputError("is damaged: it knows depths beyond any map")
    known = level > 0
    z = _depth_of(level)
    centre, right, down = ((plane - _ZERO) * _STEP / z for plane in told)
    depth[:, :, DEPTH] = np.where(known, z, np.inf)
    for column, plane in (
        (INVERSE, centre + 1.0 / z),
        (RIGHT, right / cell_px(lens)),
        (DOWN, down / cell_px(lens)),
    ):
        depth[:, :, column] = np.where(known, plane, 0.0)
    return depth


def _decoded(content: bytes, shape: tuple[int, int]) -> F64 | None:
    """The numbers (h, w) in a file's picture of 16 bits; None where it is none of that shape."""
    if _size_of(content) != shape:
        return None  # a small file may hold a picture that fills the memory
    try:
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    if picture is None or picture.dtype != np.uint16 or picture.shape != shape:
        return None
    return np.asarray(picture, np.float64)


def _size_of(content: bytes) -> tuple[int, int]:
    """Height and width that the header of a PNG tells, zeros where the file is none."""
    if len(content) < _HEADER.size:
        return 0, 0
    signature, chunk, width, height = _HEADER.unpack_from(content)
    return (height, width) if (signature, chunk) == (_PNG_SIGNATURE, b"IHDR") else (0, 0)


def _depth_of(level: F64) -> F64:
    """Depth [m] of the numbers in the first picture."""
    return np.asarray(NEAR_M * np.exp((level - 1.0) * _STEP))
