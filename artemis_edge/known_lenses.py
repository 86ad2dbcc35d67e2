"""``map/lenses.json``: the fall-off of the cameras' lenses, as the mapping found it.

``{"lenses": [{"camera", "fx", "fy", "cx", "cy", "distortion", "falloff"}]}``, ``falloff`` as ``lens.log_falloff``
takes it. With it a picture of the map can be darkened as a photograph by that camera is.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.export.atomic import write_bytes
from artemis_edge.frames import F64, CameraModel
from artemis_edge.json_file import read_json

FILE = "lenses.json"
_DIGITS = 6
# A camera given with intrinsics so near to a lens's is that camera: written with a few digits, or calibrated anew
_SAME_PX, _SAME_SHARE = 2.0, 0.005


def write_lenses(folder: Path, lenses: Mapping[str, tuple[CameraModel, F64]]) -> int:
    """Write the lenses of cameras by name into a map's folder; returns the size in bytes (0: none is known)."""
    if not lenses:
        return 0
    entries = [_entry(name, model, falloff) for name, (model, falloff) in lenses.items()]
    content = (json.dumps({"lenses": entries}, indent=1) + "\n").encode()
    write_bytes(folder / FILE, content)
    return len(content)


def _entry(name: str, model: CameraModel, falloff: F64) -> dict[str, Any]:
    return {
        "camera": name,
        "fx": model.fx,
        "fy": model.fy,
        "cx": model.cx,
        "cy": model.cy,
        "distortion": list(model.distortion),
        "falloff": [round(float(a), _DIGITS) for a in falloff],
    }


def known_falloff(folder: Path | None, camera: CameraModel) -> tuple[float, ...]:
    """Fall-off of the lens with the intrinsics of ``camera``, the nearest of several; empty where none is known.

    Raises InputError for a file that is not whole.
    """
    path = None if folder is None else folder / FILE
    if path is None or not path.is_file():
        return ()
    try:
        lenses = [
            (
                _apart(camera, *(float(entry[key]) for key in ("fx", "fy", "cx", "cy"))),
                tuple(float(a) for a in entry["falloff"]),
            )
            for entry in read_json(path)["lenses"]
        ]
    except (KeyError, TypeError, ValueError, OSError):
        raise InputError(f"{path} is damaged; make the map again") from None
    near = [lens for lens in lenses if lens[0] <= 1.0 and np.isfinite(lens[1]).all()]
    return min(near, key=lambda lens: lens[0])[1] if near else ()


def _apart(camera: CameraModel, fx: float, fy: float, cx: float, cy: float) -> float:
    """How unlike two cameras are; up to 1 they count as one."""
    focal = max(abs(camera.fx / fx - 1.0), abs(camera.fy / fy - 1.0))
    return max(focal / _SAME_SHARE, abs(camera.cx - cx) / _SAME_PX, abs(camera.cy - cy) / _SAME_PX)
