"""What live questions cost the mapping: CPU and wall time of its frames without questions, and with masks at 5 Hz.

    python tests/bench/bench_live_questions.py SESSION [--query TEXT]...

The network works between frames here: nothing but the share of the mapping is in the times. What a network beside it
takes from a busy machine is told by bench_service.py.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from collections import deque
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from artemis_edge import topics
from artemis_edge.config import Config
from artemis_edge.datasets.bag_index import IMAGES
from artemis_edge.datasets.cameras import encoded_image
from artemis_edge.segmentation.engine import Job, run_job
from artemis_edge.segmentation.registry import Registry
from artemis_edge.service.questions import Desk
from artemis_edge.session.feed import messages
from artemis_edge.session.late_masks import pack
from artemis_edge.session.message_ring import Sent
from artemis_edge.session.messages import Message, Text
from artemis_edge.session.stream_mapping import StreamMapping, warm_up

QUESTIONS = ("car", "person", "bench", "tree", "building", "bicycle", "pole", "sign")
_EVERY, _LATE = 2, 3  # photographs; frames until a mask comes


def sent(topic: str, message: Message) -> Sent:
    """As the ring gives it."""
    return Sent(0, topic, message.ROS_TYPE, 0, 0, message.encode())


def run(session: Path, questions: Sequence[str], folder: Path) -> dict[str, object]:
    """Map it; times of the frames after the first ten."""
    entry = Registry().find()
    backend, desk = entry.open(), Desk(entry.manifest)
    for text in questions:
        desk.ask(text)
    mapping = StreamMapping(Config(), folder, questions=True)
    mapping.take(sent(topics.QUESTIONS.name, Text(json.dumps(desk.asked().plain()))))
    late: deque[tuple[int, Sent]] = deque()
    network, photographs = [], 0
    for message in messages(session):
        mapping.take(message)
        frame = mapping.assembler.next_index
        while late and late[0][0] <= frame:
            mapping.take(late.popleft()[1])
        if message.ros_type not in IMAGES or not questions:
            continue
        photographs += 1
        if photographs % _EVERY:
            continue
        photo = IMAGES[message.ros_type].decode(message.data)
        result = run_job(backend, Job(encoded_image(photo), desk.asked().prompts))
        network.append(result.cpu_ms)
        assert result.segmentation is not None
        mask = pack(
            photo.header.frame_id, photo.header.stamp_ns, desk.asked().prompts, result.segmentation.dense
        )
        late.append((frame + _LATE, sent(topics.MASKS.name, mask)))
    figures = {}
    for name, values in (("cpu_ms", mapping.statistics.cpu_ms), ("wall_ms", mapping.statistics.frame_ms)):
        figures[name] = {q: round(float(np.percentile(values[10:], q)), 1) for q in (50, 90, 99)}
    stages = {
        name: round(float(np.median([ms for ms in values if ms > 0.0] or [0.0])), 1)
        for name, values in mapping.statistics.stage_ms.items()
    }
    masks = mapping.masks.fused if mapping.masks is not None else 0
    return {
        "frames": len(mapping.statistics.cpu_ms),
        "masks": masks,
        **figures,
        "stages_wall_ms": stages,
        "network_cpu_ms": round(float(np.median(network)), 1) if network else None,
    }


def main() -> None:
    """Both, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("session", type=Path)
    parser.add_argument("--query", action="append", default=[])
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        warm_up(Config(), Path(folder) / "warm-up", questions=True)
        for number, questions in enumerate(((), given.query or QUESTIONS)):
            place = Path(folder) / str(number)
            place.mkdir()
            print(
                json.dumps(
                    {
                        "questions": len(questions),
                        "load": os.getloadavg()[0],
                        **run(given.session, questions, place),
                    }
                )
            )


if __name__ == "__main__":
    main()
