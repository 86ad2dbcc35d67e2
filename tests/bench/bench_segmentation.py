"""A model on labelled photographs: IoU of car and person, and what an image costs.

    python tests/bench/bench_segmentation.py FILE.onnx [--size HxW]... [--camvid FOLDER] [--coco FOLDER] [--score S]

``--camvid`` is a CamVid folder (val, valannot, ...), ``--coco`` one with panoptic_examples.json. Without them those
under $ARTEMIS_DATA are used. A pixel belongs to a class where the mask of an instance of at least the score is over
one half. CamVid's car includes trucks and buses; its cyclists are neither person nor background and are left out.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from artemis_edge.frames import U8, Bool
from artemis_edge.segmentation.backend import Backend, Prompt
from artemis_edge.segmentation.manifest import Manifest
from artemis_edge.segmentation.network import Network
from artemis_edge.segmentation.opening import guess_kind, names_in, open_model
from artemis_edge.segmentation.yolo_seg import Thresholds

WORDS = {"car": ("car", "truck", "bus"), "person": ("person",)}
PROMPTS = tuple(Prompt(k + 1, word) for k, word in enumerate(sorted(sum(WORDS.values(), ()))))
CAMVID_CLASSES = {"car": 8, "person": 9}
CAMVID_LEFT_OUT = (10, 11)  # cyclists, void
COCO_CLASSES = {"car": (3, 6, 8), "person": (1,)}

Labelled = tuple[U8, dict[str, Bool], Bool]  # photograph, truth of each class, what counts


def camvid(folder: Path) -> Iterator[Labelled]:
    for annotation in sorted(folder.rglob("*annot/*.png")):
        photograph = (
            annotation.parent.with_name(annotation.parent.name.removesuffix("annot")) / annotation.name
        )
        ids = cv2.imread(str(annotation), cv2.IMREAD_UNCHANGED)
        truth = {name: ids == number for name, number in CAMVID_CLASSES.items()}
        yield read(photograph), truth, ~np.isin(ids, CAMVID_LEFT_OUT)


def coco(folder: Path) -> Iterator[Labelled]:
    said = json.loads((folder / "panoptic_examples.json").read_text())
    files = {row["id"]: row["file_name"] for row in said["images"]}
    for row in said["annotations"]:
        colour = cv2.imread(str(folder / "panoptic_examples" / row["file_name"])).astype(np.int64)
        ids = colour[:, :, 2] + 256 * colour[:, :, 1] + 65536 * colour[:, :, 0]  # red is the lowest byte
        crowds = [part["id"] for part in row["segments_info"] if part["iscrowd"]]
        truth = {
            name: np.isin(ids, [p["id"] for p in row["segments_info"] if p["category_id"] in numbers])
            for name, numbers in COCO_CLASSES.items()
        }
        yield (
            read(folder / "input_images" / files[row["image_id"]]),
            truth,
            ~np.isin(ids, crowds) & (ids != 0),
        )


def read(path: Path) -> U8:
    return np.asarray(cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB), np.uint8)


def measure(backend: Backend, images: Iterator[Labelled]) -> dict[str, object]:
    both, either = dict.fromkeys(WORDS, 0), dict.fromkeys(WORDS, 0)
    cpu_ms = []
    for image, truth, counts in images:
        start = time.process_time()
        found = backend.segment(image, PROMPTS)
        cpu_ms.append((time.process_time() - start) * 1e3)
        for name, words in WORDS.items():
            mask = np.zeros(image.shape[:2], bool)
            for item in found.instances:
                if item.text in words:
                    mask |= item.image_mask(found.width, found.height) > 0.5
            both[name] += int((mask & truth[name] & counts).sum())
            either[name] += int(((mask | truth[name]) & counts).sum())
    iou = {name: round(both[name] / max(either[name], 1), 3) for name in WORDS}
    return {"images": len(cpu_ms), "iou": iou, "cpu_ms": round(statistics.median(cpu_ms), 1)}


def open_file(path: Path, size: tuple[int, int], score: float) -> Backend:
    network = Network(path)
    said = Manifest(
        name=path.stem[:60], kind=guess_kind(network), file=path.name, sha256="0" * 64, licence="",
        classes=names_in(network), input_size=size,
    )  # fmt: skip
    return open_model(said, path.parent, Thresholds(score=score))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    data = Path(os.environ.get("ARTEMIS_DATA", "."))
    parser.add_argument("file", type=Path)
    parser.add_argument("--size", action="append", default=[], help="for networks of any input size")
    parser.add_argument("--camvid", type=Path, default=data / "camvid_sample/CamVid")
    parser.add_argument("--coco", type=Path, default=data / "coco_panoptic_1")
    parser.add_argument("--score", type=float, default=Thresholds().score)
    given = parser.parse_args()
    for text in given.size or ["448x448"]:
        height, _, width = text.partition("x")
        if not given.camvid.is_dir():
            parser.error(f"no photographs in {given.camvid}; set ARTEMIS_DATA or give --camvid and --coco")
        backend = open_file(given.file, (int(height), int(width)), given.score)
        for name, images in (("camvid", camvid(given.camvid)), ("coco", coco(given.coco))):
            print(json.dumps({"model": backend.name, "size": text, "set": name, **measure(backend, images)}))


if __name__ == "__main__":
    main()
