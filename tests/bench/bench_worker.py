"""What segmentation beside the pipeline costs the pipeline: the calls that it makes, with the network always busy.

    python tests/bench/bench_worker.py PHOTO [--model NAME] [--query TEXT]... [--frames N]

A frame every 100 ms offers a photograph and fetches what is done. Printed are CPU and wall time of the two calls (the
wall time includes what other programs of the machine take), masks a second, and how late they are, in frames.
"""

from __future__ import annotations

import argparse
import json
import time
from functools import partial
from pathlib import Path

import numpy as np

from artemis_edge.frames import CameraImage, CameraModel
from artemis_edge.segmentation.engine import ProcessEngine
from artemis_edge.segmentation.knowledge import Knowledge
from artemis_edge.segmentation.live import LiveQuestions
from artemis_edge.segmentation.registry import Registry, open_by_name
from artemis_edge.segmentation.worker import LatestWins

_FRAME_S = 0.1


def run(live: LiveQuestions[int], photograph: bytes, frames: int) -> dict[str, object]:
    model = CameraModel(1, 1, 1.0, 1.0, 0.0, 0.0)
    cpu_ms, wall_ms, late = [], [], []
    for frame in range(frames):
        image = CameraImage("camera", frame * 100_000_000, photograph, model, np.eye(4))
        cpu, wall = time.thread_time(), time.perf_counter()
        seen = live.ready()
        live.offer(image, frame)
        cpu_ms.append((time.thread_time() - cpu) * 1e3)
        wall_ms.append((time.perf_counter() - wall) * 1e3)
        late += [frame - mask.context for mask in seen]
        time.sleep(_FRAME_S)
    tally = live.worker.tally
    return {
        "cpu_ms": {
            "p50": round(float(np.median(cpu_ms)), 3),
            "p99": round(float(np.percentile(cpu_ms, 99)), 3),
        },
        "wall_ms": {
            "p50": round(float(np.median(wall_ms)), 3),
            "p99": round(float(np.percentile(wall_ms, 99)), 3),
        },
        "masks_per_s": round(tally.segmented / (frames * _FRAME_S), 2),
        "late_frames": {"mean": round(float(np.mean(late)), 2), "max": int(np.max(late))} if late else None,
        "network_cpu_ms": round(tally.cpu_ms / max(tally.segmented, 1), 1),
        "fault": live.worker.fault or tally.first_fault,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("photo", type=Path)
    parser.add_argument("--model", default="")
    parser.add_argument("--query", action="append", default=[])
    parser.add_argument("--frames", type=int, default=100)
    given = parser.parse_args()
    entry = Registry().find(given.model)
    engine = ProcessEngine(partial(open_by_name, entry.manifest.name))
    try:
        live: LiveQuestions[int] = LiveQuestions(Knowledge(entry.manifest), LatestWins(engine, ()))
        for text in given.query or ["car", "person", "bench", "bicycle", "dog", "chair", "truck", "backpack"]:
            live.add(text)
        engine.wait_until_ready()
        print(json.dumps({"model": entry.manifest.name, **run(live, given.photo.read_bytes(), given.frames)}))
    finally:
        engine.close()


if __name__ == "__main__":
    main()
