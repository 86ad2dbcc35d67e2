"""What attached terminals cost the mapping: CPU of its thread a frame with 0, 1 and 3 of them, and one that leaves.

    python tests/bench/bench_viewers.py [--frames N]

The terminals are real ones (tmux); the control socket is answered by another thread, as it is by another process in
``run``. The map must be the same, byte for byte.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from artemis_edge.config import Config
from artemis_edge.service.control import ControlSocket, viewers_path
from artemis_edge.service.map_feed import MapFeed
from artemis_edge.session.feed import messages
from artemis_edge.session.message_ring import Sent
from artemis_edge.session.stream_mapping import StreamMapping
from artemis_edge.status import Status
from tests import small_session
from tests.terminal import Terminal

_SIZE = (160, 48)
_PATIENCE_S = 120.0


def _answer(what: str, request: dict[str, Any]) -> dict[str, Any]:
    return dict(msgspec.to_builtins(Status(state="recording")))


def run(sent: list[Sent], viewers: int, kill: bool, folder: Path) -> tuple[list[float], str, int]:
    """Milliseconds of CPU of each frame, a hash of the mesh, and the frames dropped."""
    control = ControlSocket(folder / "s", 0o600, _answer)
    feed = MapFeed(viewers_path(folder / "s"), 0o600)
    over = threading.Event()

    def serve() -> None:
        while not over.is_set():
            control.turn(dict, 0.02)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        with contextlib.ExitStack() as stack:
            words = ["tui", "--socket", str(folder / "s")]
            terminals = [stack.enter_context(Terminal(words, _SIZE, folder)) for _ in range(viewers)]
            end = time.monotonic() + _PATIENCE_S
            while len(feed) < viewers and time.monotonic() < end:
                feed.turn()
                time.sleep(0.05)
            assert len(feed) == viewers
            mapping, spent = StreamMapping(Config(), folder), []
            for each in sent:
                begun = time.thread_time()
                if mapping.take(each):
                    if mapping.delta is not None:
                        feed.add(mapping.delta)
                    if feed.turn():
                        mapping.mapper.tell_everything()
                    spent.append((time.thread_time() - begun) * 1e3)
                    if kill and len(spent) == 20:
                        terminals[0].press("C-c")
                        terminals[0].press("q")
            mapping.mapper.finish()
            mapping.mapper.write_mesh(folder / "mesh.ply")
            mesh = hashlib.sha256((folder / "mesh.ply").read_bytes()).hexdigest()[:12]
            return spent, mesh, mapping.statistics.frames_dropped
    finally:
        over.set()
        thread.join()
        control.close()
        feed.close()


def main() -> None:
    """Print a line for each case; the first one only warms up."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=60)
    frames = parser.parse_args().frames
    with tempfile.TemporaryDirectory() as name:
        session = small_session.write(Path(name) / "walk", frames=frames, points=6000)
        sent = list(messages(session))
        none = 0.0
        for k, (viewers, kill) in enumerate(
            [(0, False), (0, False), (1, False), (3, False), (1, True), (0, False)]
        ):
            folder = Path(name) / str(k)
            folder.mkdir()
            spent, mesh, dropped = run(sent, viewers, kill, folder)
            p50 = float(np.median(spent[5:]))
            none = p50 if k == 1 else none
            if k:
                print(
                    f"{viewers} attached{', one leaves' if kill else '':12} p50 {p50:6.2f} ms, {p50 / none - 1:+6.1%}; "
                    f"{len(spent)} frames, {dropped} dropped, mesh {mesh}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
