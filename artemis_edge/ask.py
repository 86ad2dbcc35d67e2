"""``ask``: questions about a finished map, answered from its photographs without walking back.

Every kept photograph is segmented for the classes of the questions, and its masks refine the vertices of the
finished mesh by eqs 12 and 13, with occlusion by the depth that the map had when the photograph was taken; where it
knew nothing then, the photograph tells nothing. Of maps made without that depth, occlusion is by the mesh itself.
The map on disk stays as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from artemis_edge.block_store import CLASSES, LOG_CLASS
from artemis_edge.config import Config, SemanticsConfig, load
from artemis_edge.errors import InputError
from artemis_edge.export.mesh import Mesh
from artemis_edge.export.objects import object_mesh
from artemis_edge.export.ply import find_mesh, read_mesh, write_ply
from artemis_edge.frames import F32
from artemis_edge.highlight import Reply, answer, objects_of
from artemis_edge.map_view import visibility
from artemis_edge.opened_map import map_folder
from artemis_edge.progress import Report, say, silent
from artemis_edge.questions import Questions, unanswered
from artemis_edge.refinement.agreement import agreed
from artemis_edge.refinement.semantics import labels_of, refine_rows
from artemis_edge.segmentation.backend import Segmentation
from artemis_edge.segmentation.keyframes import Keyframe, read_keyframes, segment_all
from artemis_edge.segmentation.query import shown
from artemis_edge.segmentation.registry import open_by_name
from artemis_edge.segmentation.yolo_seg import Thresholds
from artemis_edge.semantic_map import BACKGROUND, active_slots, slot_layers, spread_labels
from artemis_edge.sight import (
    cell_px,
    hiding_the_unknown,
    keep_visible,
    new_seen,
    new_sight,
    see_rows,
    splat_depth,
)
from artemis_edge.voxel_fusion import grid_of, sample_scores


def ask(
    map_path: Path,
    texts: Sequence[str],
    model: str = "",
    report: Report = silent,
    meshes: Path | None = None,
) -> list[Reply]:
    """What a finished map answers to each question; ``meshes`` receives a PLY file for each object found.

    Raises InputError when there is no map, it has no photographs, or the model cannot be used.
    """
    mesh, folder = read_mesh(find_mesh(map_path)), map_folder(map_path)
    if folder is None:
        raise InputError(f"{map_path} has no folder map/ beside its mesh; give the output directory of a run")
    config = _config(folder)
    questions = Questions.of(texts, model or config.segmentation.model, Thresholds.by(config.segmentation))
    if not questions.names:
        return unanswered(questions, "nothing in it can be looked for")
    backend = open_by_name(questions.model, questions.thresholds, fine=True)
    brush = MeshBrush(mesh, questions.names, config.semantics, config.voxel_map.voxel_m / 4)
    keyframes, refused, refused_depth = read_keyframes(folder), list[str](), list[str]()
    for keyframe, seen in segment_all(keyframes, backend, questions.prompts, report, refused.append):
        brush.refine(keyframe, seen, refused_depth.append)
    _tell_refused(refused, len(keyframes))
    if refused_depth:
        say(f"note: {len(refused_depth)} depth maps could not be used; the first: {refused_depth[0]}")
    report(len(keyframes), len(keyframes), "telling objects apart")
    labelled, probability = brush.labelled()
    replies = answer(questions.asked, objects_of(labelled, probability))
    if meshes is not None:
        _write_meshes(meshes, labelled, replies)
    return replies


def _tell_refused(refused: Sequence[str], count: int) -> None:
    if count and len(refused) == count:
        raise InputError(
            f"none of the {count} photographs of the map can be looked at: {refused[0]}; map it again"
        )
    if refused:
        say(f"note: {len(refused)} of {count} photographs could not be looked at; the first: {refused[0]}")


def _config(folder: Path) -> Config:
    path = folder / "config.toml"
    return load(path) if path.is_file() else Config()


class MeshBrush:
    """Class probabilities on a finished mesh."""

    def __init__(self, mesh: Mesh, names: Sequence[str], config: SemanticsConfig, spacing_m: float) -> None:
        self._mesh, self._config, self._spacing_m = mesh, config, spacing_m
        self._names = {0: BACKGROUND} | dict(enumerate(names, start=1))
        self._active = active_slots(self._names)
        self._rows = np.concatenate((mesh.vertices, mesh.normals), axis=1).astype(np.float32)
        self._attribute = np.zeros((len(mesh.vertices), LOG_CLASS + CLASSES), np.float32)
        self._seen = new_seen(len(mesh.vertices))
        self._scratch = np.empty(CLASSES, np.float32)

    def refine(
        self, keyframe: Keyframe, found: Segmentation, refuse: Callable[[str], None] = lambda sentence: None
    ) -> int:
        """Eqs 12 and 13 for what a photograph sees; returns how many vertices it sees.

        ``refuse`` is told where the depth that was kept with it cannot be used.
        """
        sight, seen, dense = new_sight(keyframe.model, keyframe.T_world_cam), self._seen, found.dense
        size, depth = cell_px(sight.lens), keyframe.known_depth(sight.lens, refuse)
        n = int(see_rows(self._rows, sight.T_cam_world, sight.lens, self._config.reach_m, seen))
        if depth.size > 0:
            depth = hiding_the_unknown(depth)
        else:
            depth = sight.depth
            splat_depth(seen, n, sight.lens[0], self._spacing_m, size, depth)
        n = int(keep_visible(seen, n, size, depth, visibility(self._config)))
        sampled = np.empty((n, dense.score.shape[2]), np.float32)
        sample_scores(seen, n, dense.score, grid_of(dense), sampled)
        refine_rows(self._attribute, seen, n, sampled, slot_layers(dense), seen.reliability, self._scratch)
        return n

    def labelled(self) -> tuple[Mesh, F32]:
        """The mesh with the labels found, and the probability of each vertex' label (0 where nothing was seen)."""
        label, probability = np.zeros(len(self._rows), np.uint8), np.zeros(len(self._rows), np.float32)
        mesh, lam = self._mesh, self._attribute[:, LOG_CLASS:]
        weight = self._config.agreement
        lam = agreed(lam, self._active, mesh.vertices, mesh.normals, mesh.faces, self._spacing_m, weight)
        labels_of(lam, self._active, label, probability, self._scratch)
        label = spread_labels(label, probability > 0.0, mesh.normals, mesh.faces, self._config.spread_rings)
        return replace(mesh, labels=label, label_names=self._names), probability


def _write_meshes(folder: Path, mesh: Mesh, replies: Sequence[Reply]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for found in {found.item.id: found for reply in replies for found in reply.found}.values():
        write_ply(
            folder / f"{found.item.id:04d}_{found.item.name.replace(' ', '_')}.ply", object_mesh(mesh, found)
        )


def to_text(replies: Sequence[Reply]) -> str:
    """The replies for people."""
    lines = []
    for reply in replies:
        why = f" ({reply.reason})" if reply.reason else ""
        lines.append(f"{shown(reply.text)}: {reply.status.replace('_', ' ')}{why}")
        for found in reply.found:
            x, y, z = found.item.centroid
            long, wide, high = found.item.box.size
            lines.append(
                f"  {found.item.name} {found.item.id}: score {found.score:.2f} at {x:.1f} {y:.1f} {z:.1f}, "
                f"{long:.1f} x {wide:.1f} x {high:.1f} m"
            )
    return "\n".join(lines)
