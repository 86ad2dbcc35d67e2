"""``map/images/`` and ``map/images.json``: photographs of the run, in bounded number, with their poses.

The index has the form of PHOTOS.json. Exporters and the colouring of points use them.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.export.atomic import write_bytes
from artemis_edge.frames import F64, CameraImage, Trajectory
from artemis_edge.json_file import read_json
from artemis_edge.progress import say
from artemis_edge.session.photos import camera_of, file_of, photo_entry, view_of
from artemis_edge.trajectory import covered, interpolate

FOLDER = "images"
INDEX = "images.json"


class ImageSpool:
    """Takes images as they come; beyond ``most`` every second one of each camera goes, later ones come sparser."""

    def __init__(self, folder: Path, most: int) -> None:
        self._folder, self._most = folder, most
        self._stride = 1
        self._offered: dict[str, int] = {}
        self._kept: list[tuple[int, str, CameraImage]] = []  # number within its camera, file name, image
        self._placed: dict[str, F64] = {}  # T_world_cam of images of a map made before, by file name

    def take_over(self, folder: Path) -> None:
        """Begin with the images of a map made before; InputError where their index is damaged."""
        index, missing, repeated = folder / INDEX, list[str](), list[str]()
        taken = set[tuple[str, int]]()  # by camera and number, which thinning must tell apart
        try:
            entries = read_json(index)["photos"] if index.is_file() else []
            for entry in entries:
                source = folder / str(entry["file"])
                if not source.is_file():
                    missing.append(source.name)
                elif (which := camera_of(source.name)) in taken:
                    repeated.append(source.name)
                else:
                    taken.add(which)
                    self._take(source, entry, *which)
        except (AttributeError, KeyError, OverflowError, TypeError, ValueError):
            raise InputError(f"{index} is damaged; make that map again") from None
        if missing:
            say(
                f"{len(missing)} of the {len(entries)} photographs that {index} names are missing; "
                "it goes on without them"
            )
        if repeated:
            say(
                f"{len(repeated)} entries of {index} name a photograph again, the first: {repeated[0]}; "
                "it keeps the first entry of each"
            )
        self._thin()

    def _take(self, source: Path, entry: dict[str, Any], camera: str, number: int) -> None:
        view = view_of(entry)
        image = CameraImage(camera, int(entry.get("stamp_ns", 0)), b"", view.camera, np.eye(4))
        shutil.copyfile(source, self._folder / source.name)
        self._offered[camera] = max(self._offered.get(camera, 0), number + 1)
        self._kept.append((number, source.name, image))
        self._placed[source.name] = view.T_world_cam

    def add(self, image: CameraImage) -> None:
        """Write the image, or leave it out."""
        number = self._offered.get(image.name, 0)
        self._offered[image.name] = number + 1
        if self._most == 0 or number % self._stride:
            return
        name = file_of(image, number)
        (self._folder / name).write_bytes(image.encoded)
        self._kept.append((number, name, replace(image, encoded=b"")))
        self._thin()

    def _thin(self) -> None:
        while len(self._kept) > max(self._most, len(self._offered)):
            self._stride *= 2
            for old, file, _ in self._kept:
                if old % self._stride:
                    (self._folder / file).unlink()
            self._kept = [row for row in self._kept if row[0] % self._stride == 0]

    def after_copy(self) -> None:
        """In a copy of the process that takes over: the other may have thinned out the images."""
        self._kept = [row for row in self._kept if (self._folder / row[1]).exists()]

    def save(self, folder: Path, trajectory: Trajectory) -> int:
        """Move the images with a pose into a map's folder and write their index; returns the size in bytes.

        The pose of an image is interpolated at the middle of its exposure.
        """
        stamps = np.array([image.stamp_ns for _, _, image in self._kept], np.int64)
        placed = np.array([name in self._placed for _, name, _ in self._kept], bool)
        known = np.flatnonzero(placed | covered(trajectory, stamps))
        if len(known) == 0:
            return 0
        (folder / FOLDER).mkdir()
        poses, entries, size = interpolate(trajectory, stamps), [], 0
        for k in known.tolist():
            _, name, image = self._kept[k]
            poses[k] = self._placed.get(name, poses[k])
            target = folder / FOLDER / name
            (self._folder / name).replace(target)
            size += target.stat().st_size
            entries.append(photo_entry(f"{FOLDER}/{name}", image, poses[k]) | {"stamp_ns": image.stamp_ns})
        content = (json.dumps({"photos": entries}, indent=1) + "\n").encode()
        write_bytes(folder / INDEX, content)
        return size + len(content)
