"""A map's texture against photographs that were kept out of it (``reprocess --holdout N``).

The map is rendered at each photograph's pose and through its lens. Beside it stands the baseline: the input
points, coloured by the mean of the images that see them, drawn as splats (``colouring.py``).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from artemis_edge.colouring import SplatCloud, open_splats
from artemis_edge.evaluate.likeness import channel_gains, psnr_db, ssim
from artemis_edge.evaluate.photos import Photo, count_photos, read_photos
from artemis_edge.export.atlas import Atlas
from artemis_edge.export.ply import Mesh
from artemis_edge.frames import F32, Bool
from artemis_edge.opened_map import map_folder, open_map
from artemis_edge.progress import Report, silent
from artemis_edge.render import render_coloured


@dataclass(frozen=True, slots=True)
class Likeness:
    """One picture beside its photograph: PSNR in dB, plain and after a gain per channel, and SSIM after the gain,
    all None where the picture covers nothing; ``coverage`` as a share of the photograph.
    """

    file: str
    psnr: float | None
    psnr_gain: float | None
    ssim: float | None
    coverage: float

    def to_json(self) -> dict[str, Any]:
        """Its entry in ``photos``."""
        return {
            "file": self.file,
            "psnr": self.psnr,
            "psnr_gain": self.psnr_gain,
            "ssim": self.ssim,
            "coverage": self.coverage,
        }


@dataclass(frozen=True, slots=True)
class Series:
    """The same measures over all photographs: means of those that are covered at all, coverage over all."""

    photos: tuple[Likeness, ...]

    def means(self) -> dict[str, float | None]:
        """``psnr``, ``psnr_gain``, ``ssim`` and ``coverage``."""
        return {name: self._mean(name) for name in ("psnr", "psnr_gain", "ssim", "coverage")}

    def to_json(self) -> dict[str, Any]:
        """Means and ``photos``."""
        return {**self.means(), "photos": [photo.to_json() for photo in self.photos]}

    def _mean(self, name: str) -> float | None:
        known = [value for photo in self.photos if (value := getattr(photo, name)) is not None]
        return float(np.mean(known)) if known else None


@dataclass(frozen=True, slots=True)
class TextureEvaluation:
    """The map, the baseline (None where the map keeps no points), and both on the pixels that both cover."""

    mesh: Series
    points: Series | None
    mesh_in_common: Series | None
    points_in_common: Series | None

    def to_json(self) -> dict[str, Any]:
        """The JSON object of ``evaluate texture``."""
        baseline = None
        if self.points is not None and self.mesh_in_common is not None and self.points_in_common is not None:
            common = {"mesh": self.mesh_in_common.means(), "points": self.points_in_common.means()}
            baseline = {**self.points.to_json(), "common": common}
        return {**self.mesh.to_json(), "points_baseline": baseline}


def compare(file: str, photo: Photo, picture: F32, covered: Bool) -> Likeness:
    """``picture`` float32 (h, w, 3) 0..255 beside the photograph, over the pixels ``covered`` (h, w)."""
    share = float(covered.mean())
    if share == 0.0:
        return Likeness(file, None, None, None, 0.0)
    levelled = picture * channel_gains(photo.image, picture, covered).astype(np.float32)
    return Likeness(
        file,
        psnr_db(photo.image, picture, covered),
        psnr_db(photo.image, levelled, covered),
        ssim(photo.image, levelled, covered),
        share,
    )


def evaluate_texture(
    mesh: Mesh, atlas: Atlas | None, splats: SplatCloud | None, photos: Path, report: Report = silent
) -> TextureEvaluation:
    """Compare a map with the photographs of PHOTOS.json; raises InputError for photographs of no use."""
    total = count_photos(photos)
    rows: list[tuple[Likeness, ...]] = []
    for done, photo in enumerate(read_photos(photos)):
        rows.append(_one(mesh, atlas, splats, photo))
        report(done + 1, total, photo.file)
    series = [Series(column) for column in zip(*rows, strict=True)]
    if splats is None:
        return TextureEvaluation(series[0], None, None, None)
    return TextureEvaluation(*series)


def _one(mesh: Mesh, atlas: Atlas | None, splats: SplatCloud | None, photo: Photo) -> tuple[Likeness, ...]:
    seen = render_coloured(mesh, atlas, photo.camera, photo.T_world_cam)
    whole = compare(photo.file, photo, seen.values, seen.covered)
    if splats is None:
        return (whole,)
    picture, drawn = splats.draw(photo.camera, photo.T_world_cam)
    both = seen.covered & drawn
    return (
        whole,
        compare(photo.file, photo, picture, drawn),
        compare(photo.file, photo, seen.values, both),
        compare(photo.file, photo, picture, both),
    )


def run(map_path: Path, photos: Path, report: Report = silent) -> TextureEvaluation:
    """The command ``evaluate texture``; raises InputError for files that are not what they should be."""
    mesh, atlas = open_map(map_path)
    folder = map_folder(map_path)
    return evaluate_texture(mesh, atlas, None if folder is None else open_splats(folder), photos, report)


def to_text(evaluation: TextureEvaluation) -> str:
    """The figures for people."""
    lines = [f"{len(evaluation.mesh.photos)} photographs", _line("map", evaluation.mesh)]
    if evaluation.points is None:
        lines.append("no baseline: the map keeps no coloured points")
    else:
        lines.append(_line("coloured points", evaluation.points))
    if evaluation.mesh_in_common is not None and evaluation.points_in_common is not None:
        lines.append("on the pixels that both cover:")
        lines.append(_line("map", evaluation.mesh_in_common))
        lines.append(_line("coloured points", evaluation.points_in_common))
    return "\n".join(lines)


def _line(name: str, series: Series) -> str:
    means = series.means()
    db, gained, alike = (means[key] for key in ("psnr", "psnr_gain", "ssim"))
    if db is None or gained is None or alike is None:
        return f"{name}: covers nothing"
    return (
        f"{name}: PSNR {db:.2f} dB, after gains {gained:.2f} dB, SSIM {alike:.3f}, "
        f"coverage {means['coverage']:.3f}"
    )
