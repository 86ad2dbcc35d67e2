"""What the growing mesh answers to the live questions: a viewer that looks for objects instead of drawing."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from artemis_edge.export.mesh import Mesh, bare_mesh
from artemis_edge.frames import F32, MeshDelta
from artemis_edge.highlight import Reply, answer, objects_of
from artemis_edge.segmentation.backend import FULL_SCORE
from artemis_edge.session.asked import Asked
from artemis_edge.view.live_mesh import BlockKey, LiveMesh, around, rows_of

_MOST_TOLD = 24  # objects of a question
_DIGITS = 3


class Source(Protocol):
    """Where news of the mesh comes from: ``map_feed.MapReader``."""

    def take(self) -> list[MeshDelta]:
        """What has arrived, without waiting."""
        ...


class MapAnswers:
    """Keeps a copy of the mesh; ``told`` is what it says to the questions now."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._mesh = LiveMesh()

    def told(self, asked: Asked) -> list[dict[str, Any]]:
        """A dict of plain values for each question that the model can answer."""
        for delta in self._source.take():
            self._mesh.apply(delta)
        if not asked.texts:
            return []
        mesh, probability = self.labelled(asked.slots)
        replies = answer(asked.understood(), objects_of(mesh, probability))
        return [_plain(reply) for reply in replies]

    def labelled(self, slots: dict[int, str]) -> tuple[Mesh, F32]:
        """The triangles that touch a vertex of a class asked for, and the probability of each vertex' label (n,)."""
        blocks = self._mesh.blocks
        wanted = np.array(sorted(slots), np.uint8)
        own = sorted(key for key, patch in blocks.items() if np.isin(patch.label, wanted).any())
        used: list[BlockKey] = sorted({near for key in own for near in around(key) if near in blocks})
        if not used:
            return bare_mesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32)), np.empty(
                0, np.float32
            )
        parts = [blocks[key] for key in used]
        label = np.concatenate([part.label for part in parts])
        label[~np.isin(label, wanted)] = 0
        faces = rows_of(
            np.concatenate([part.vertex_id for part in parts]),
            np.concatenate([blocks[key].triangles for key in own]),
        )
        faces = faces[(label[faces] > 0).any(axis=1)]
        kept = np.unique(faces)
        renumber = np.zeros(len(label), np.int32)
        renumber[kept] = np.arange(len(kept), dtype=np.int32)
        mesh = bare_mesh(
            np.concatenate([part.position for part in parts])[kept],
            renumber[faces],
            colours=np.concatenate([part.colour for part in parts])[kept],
            labels=label[kept],
            confidence=np.concatenate([part.confidence for part in parts])[kept],
            label_names=dict(slots),
        )
        probability = np.concatenate([part.probability for part in parts])[kept]
        return mesh, probability.astype(np.float32) / np.float32(FULL_SCORE)


def _plain(reply: Reply) -> dict[str, Any]:
    best = reply.found[:_MOST_TOLD]
    return {
        "text": reply.text,
        "status": str(reply.status),
        "note": reply.reason,
        "count": len(reply.found),
        "score": round(max((found.score for found in reply.found), default=0.0), _DIGITS),
        "places": [[round(float(v), _DIGITS) for v in found.item.centroid] for found in best],
        "boxes": [
            [
                *(round(float(v), _DIGITS) for v in (*found.item.box.centre, *found.item.box.size)),
                round(found.item.box.yaw, _DIGITS),
            ]
            for found in best
        ],
    }
