"""A map's texture against photographs that were kept out of it (``reprocess --holdout N``).

The map is rendered at each photograph's pose as its camera would take it (``render.picture``): through its lens with
distortion and fall-off, clipped where a camera clips. The fall-off is the one that the mapping found, as it stands in
PHOTOS.json or in the map; where it is known, the measures without it stand beside. Beside them stands the baseline:
the input points, coloured by the mean of the images that see them, drawn as splats (``colouring.py``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from artemis_edge.colouring import SplatCloud, open_splats
from artemis_edge.evaluate.likeness import channel_gains, psnr_db, ssim
from artemis_edge.evaluate.photos import Photo, count_photos, read_photos
from artemis_edge.export.atlas import Atlas
from artemis_edge.export.ply import Mesh
from artemis_edge.frames import F32, Bool
from artemis_edge.known_lenses import known_falloff
from artemis_edge.lens import falloff
from artemis_edge.opened_map import map_folder, open_map
from artemis_edge.progress import Report, silent
from artemis_edge.render import picture

_CLIPPED = 255.0  # as much as a photograph can hold


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
class Compared:
    """The map's picture as the camera takes it, and without the lens's fall-off (None: no lens's is known)."""

    taken: Series
    bare: Series | None


@dataclass(frozen=True, slots=True)
class TextureEvaluation:
    """The map, the baseline (None where the map keeps no points), and both on the pixels that both cover."""

    mesh: Compared
    points: Series | None
    mesh_in_common: Compared | None
    points_in_common: Series | None

    def to_json(self) -> dict[str, Any]:
        """The JSON object of ``evaluate texture``; ``without_falloff`` is there where a lens's is known."""
        bare = self.mesh.bare
        beside = {} if bare is None else {"without_falloff": bare.to_json()}
        return {**self.mesh.taken.to_json(), **beside, "points_baseline": self._baseline()}

    def _baseline(self) -> dict[str, Any] | None:
        if self.points is None or self.mesh_in_common is None or self.points_in_common is None:
            return None
        common = {"mesh": self.mesh_in_common.taken.means(), "points": self.points_in_common.means()}
        bare = self.mesh_in_common.bare
        if bare is not None:
            common["mesh_without_falloff"] = bare.means()
        return {**self.points.to_json(), "common": common}


def compare(file: str, photo: Photo, shown: F32, covered: Bool) -> Likeness:
    """``shown`` float32 (h, w, 3) 0..255 beside the photograph, over the pixels ``covered`` (h, w).

    After the gains nothing is brighter than a photograph can be.
    """
    share = float(covered.mean())
    if share == 0.0:
        return Likeness(file, None, None, None, 0.0)
    levelled = shown * channel_gains(photo.image, shown, covered).astype(np.float32)
    levelled = np.minimum(levelled, np.float32(_CLIPPED))
    return Likeness(
        file,
        psnr_db(photo.image, shown, covered),
        psnr_db(photo.image, levelled, covered),
        ssim(photo.image, levelled, covered),
        share,
    )


def evaluate_texture(
    mesh: Mesh,
    atlas: Atlas | None,
    splats: SplatCloud | None,
    photos: Path,
    report: Report = silent,
    folder: Path | None = None,
) -> TextureEvaluation:
    """Compare a map, whose folder ``map/`` is ``folder``, with the photographs of PHOTOS.json.

    Raises InputError for photographs of no use.
    """
    total = count_photos(photos)
    rows: list[tuple[Likeness | None, ...]] = []
    for done, photo in enumerate(read_photos(photos)):
        if not photo.falloff:
            photo = replace(photo, falloff=known_falloff(folder, photo.camera))
        rows.append(_one(mesh, atlas, splats, photo))
        report(done + 1, total, photo.file)
    series = [_series(column) for column in zip(*rows, strict=True)]
    whole, bare, points, both, bare_both, points_both = series
    assert whole is not None
    in_common = None if both is None else Compared(both, bare_both)
    return TextureEvaluation(Compared(whole, bare), points, in_common, points_both)


def _series(column: tuple[Likeness | None, ...]) -> Series | None:
    known = tuple(likeness for likeness in column if likeness is not None)
    return Series(known) if known else None


def _one(
    mesh: Mesh, atlas: Atlas | None, splats: SplatCloud | None, photo: Photo
) -> tuple[Likeness | None, ...]:
    """The map whole, without the fall-off, the points; the same map, without the fall-off, and points in common."""
    seen = picture(mesh, atlas, photo.camera, photo.T_world_cam)
    whole = _mesh(photo, seen.values, seen.covered)
    if splats is None:
        return *whole, None, None, None, None
    drawn, shown = splats.draw(photo.camera, photo.T_world_cam)
    both = seen.covered & shown
    points = compare(photo.file, photo, drawn, shown)
    return *whole, points, *_mesh(photo, seen.values, both), compare(photo.file, photo, drawn, both)


def _mesh(photo: Photo, bare: F32, covered: Bool) -> tuple[Likeness, Likeness | None]:
    plain = compare(photo.file, photo, bare, covered)
    if not photo.falloff:
        return plain, None
    taken = bare * falloff(photo.camera, photo.falloff)[..., None]
    return compare(photo.file, photo, taken, covered), plain


def run(map_path: Path, photos: Path, report: Report = silent) -> TextureEvaluation:
    """The command ``evaluate texture``; raises InputError for files that are not what they should be."""
    count_photos(photos)  # a wrong file is told before minutes of work
    mesh, atlas = open_map(map_path)
    folder = map_folder(map_path)
    splats = None if folder is None else open_splats(folder, report)
    return evaluate_texture(mesh, atlas, splats, photos, report, folder)


def to_text(evaluation: TextureEvaluation) -> str:
    """The figures for people."""
    lines = [f"{len(evaluation.mesh.taken.photos)} photographs", *_mesh_lines(evaluation.mesh)]
    if evaluation.points is None:
        lines.append("no baseline: the map keeps no coloured points")
    else:
        lines.append(_line("coloured points", evaluation.points))
    if evaluation.mesh_in_common is not None and evaluation.points_in_common is not None:
        lines.append("on the pixels that both cover:")
        lines += _mesh_lines(evaluation.mesh_in_common)
        lines.append(_line("coloured points", evaluation.points_in_common))
    return "\n".join(lines)


def _mesh_lines(mesh: Compared) -> list[str]:
    lines = [_line("map", mesh.taken)]
    return lines if mesh.bare is None else [*lines, _line("map, without the lens's fall-off", mesh.bare)]


def _line(name: str, series: Series) -> str:
    means = series.means()
    db, gained, alike = (means[key] for key in ("psnr", "psnr_gain", "ssim"))
    if db is None or gained is None or alike is None:
        return f"{name}: covers nothing"
    return (
        f"{name}: PSNR {db:.2f} dB, after gains {gained:.2f} dB, SSIM {alike:.3f}, "
        f"coverage {means['coverage']:.3f}"
    )
