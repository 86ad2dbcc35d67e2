"""PHOTOS.json and the photographs it names."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from artemis_edge.errors import InputError
from artemis_edge.frames import F64, U8, CameraModel
from artemis_edge.json_file import read_json
from artemis_edge.segmentation.trial import decode
from artemis_edge.session.photos import EntryError, view_of

# A lens that leaves e^-10 of the light in its corners leaves none; far beyond it numbers overflow.
_STEEPEST_FALLOFF = 10.0


class PictureError(InputError):
    """A picture file that is missing or damaged."""


@dataclass(frozen=True, slots=True)
class Photo:
    """A photograph: ``image`` uint8 (h, w, 3) RGB, its camera, and ``T_world_cam`` (4, 4).

    ``falloff`` holds the coefficients of the lens's fall-off (``lens.log_falloff``), none where it is not known.
    """

    file: str
    image: U8
    camera: CameraModel
    T_world_cam: F64
    falloff: tuple[float, ...] = ()


def read_photos(path: Path, unreadable: Callable[[str], None] | None = None) -> Iterator[Photo]:
    """The photographs of PHOTOS.json one by one; file names are relative to its folder.

    Raises InputError for an index or a photograph that cannot be used. With ``unreadable`` a picture that is missing
    or damaged is left out, and the sentence about it is handed over.
    """
    for number, entry in enumerate(_entries(path)):
        try:
            yield _photo(path.parent, entry, f"photo {number} of {path}")
        except PictureError as error:
            if unreadable is None:
                raise
            unreadable(str(error))


def count_photos(path: Path) -> int:
    """How many photographs the index names, of which there must be some; InputError as above."""
    return len(_entries(path))


def _entries(path: Path) -> list[Any]:
    try:
        content = read_json(path)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except ValueError:
        raise InputError(f"{path} is not JSON; `reprocess --holdout N` writes PHOTOS.json") from None
    entries = content.get("photos") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path} names no photos; `reprocess --holdout N` writes PHOTOS.json")
    return entries


def _photo(folder: Path, entry: Any, where: str) -> Photo:
    try:
        file = str(entry["file"])
        view = view_of(entry)
        falloff = tuple(float(a) for a in entry.get("falloff", ()))
    except EntryError as error:
        raise InputError(f"{where}: {error}") from None
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError):
        raise InputError(
            f"{where} is not complete; it needs file, fx, fy, cx, cy, distortion and T_cam_world"
        ) from None
    if not all(abs(a) <= _STEEPEST_FALLOFF for a in falloff):
        raise InputError(f"{where}: its falloff is no lens's; coefficients are at most {_STEEPEST_FALLOFF:g}")
    image = read_image(folder / file)
    height, width = image.shape[:2]
    camera = replace(view.camera, width=width, height=height)
    return Photo(file, image, camera, view.T_world_cam, falloff)


def read_image(path: Path) -> U8:
    """A picture file as RGB uint8 (h, w, 3); PictureError if it cannot be read."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise PictureError(f"cannot read the photograph {path}: {error.strerror}") from None
    return decoded(content, str(path))


def decoded(content: bytes, name: str) -> U8:
    """An encoded picture as RGB uint8 (h, w, 3); PictureError naming it if it is none."""
    image = decode(content)
    if image is None:
        raise PictureError(f"{name} is not a picture that can be decoded; take it out or copy it again")
    return image
