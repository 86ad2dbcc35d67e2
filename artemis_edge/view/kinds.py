"""Ways to colour a map: as textured, or by label, confidence or coverage."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

import numpy as np

from artemis_edge.export.atlas import UNTEXTURED, Atlas
from artemis_edge.export.mesh import Mesh
from artemis_edge.frames import F32, U8
from artemis_edge.session.drawing import LABEL_COLOURS, scale_colours

Kind = Literal["texture", "label", "confidence", "coverage"]
KINDS: tuple[Kind, ...] = get_args(Kind)
# Of surfaces: photographed, and not yet
_SEEN, _UNSEEN = np.array([60, 160, 90], np.uint8), np.array([240, 120, 30], np.uint8)
# Shading that shows the shape where a colour has none: a light above and ahead, the rest from everywhere.
_LIGHT = np.array([0.35, 0.2, 0.9], np.float32) / np.float32(np.linalg.norm([0.35, 0.2, 0.9]))
_AMBIENT = np.float32(0.55)


def coloured(mesh: Mesh, kind: Kind, atlas: Atlas | None = None) -> Mesh:
    """The mesh with vertex colours of one kind; ``texture`` leaves them as they are.

    ``coverage``: green where photographs have been taken, orange where not: by the atlas, or without one by
    whether a vertex has a colour of its own.
    """
    if kind == "texture":
        return mesh
    if kind == "label":
        colours = LABEL_COLOURS[mesh.labels % len(LABEL_COLOURS)]
    elif kind == "confidence":
        colours = scale_colours(mesh.confidence)
    else:
        colours = _coverage(mesh, atlas)
    return replace(mesh, colours=shaded(colours, mesh.normals))


def shaded(colours: U8, normals: F32) -> U8:
    """Colours under a light; either side of a surface counts."""
    light = _AMBIENT + (1 - _AMBIENT) * np.abs(normals @ _LIGHT)
    out: U8 = np.rint(colours * light[:, None]).clip(0, 255).astype(np.uint8)
    return out


def _coverage(mesh: Mesh, atlas: Atlas | None) -> U8:
    if atlas is None:
        seen = np.ptp(mesh.colours.astype(np.int16), axis=1) > 0  # what no camera saw is grey
    else:
        seen = np.zeros(len(mesh.vertices), bool)
        seen[mesh.faces[atlas.page != UNTEXTURED]] = True
    return np.where(seen[:, None], _SEEN, _UNSEEN)
