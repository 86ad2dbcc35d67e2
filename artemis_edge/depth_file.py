"""The reference depth of a view as a file: what the map knew of it when its photograph was taken.

A PNG of 16 bits and one channel: four pictures of the depth map's cells one below the other. The first is the logarithm
of the depth, 0 where nothing is known; the others are, relative to the depth, the plane's inverse depth at the cell's
centre less 1, and its change over a cell to the right and down.
"""

from __future__ import annotations

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
    try:
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED) if content else None
    except cv2.error:
        picture = None
    if picture is None or picture.dtype != np.uint16 or picture.shape != (count * high, wide):
        raise InputError(f"is not a depth map of {wide} x {high} cells")
    level, *told = np.split(picture.astype(np.float64), count)
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


def _depth_of(level: F64) -> F64:
    """Depth [m] of the numbers in the first picture."""
    return np.asarray(NEAR_M * np.exp((level - 1.0) * _STEP))
