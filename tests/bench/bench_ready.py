"""How long ``artemis-edge run`` takes until systemd hears READY=1, several times over, with a warm cache.

python tests/bench/bench_ready.py [--times N]
"""

from __future__ import annotations

import argparse
import os
import resource
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

_PATIENCE_S = 60.0
_CONFIG = """
[[lidar]]
avia = {}
[service]
record_at_start = false
sessions = "sessions"
socket = "s"
"""


def once(folder: Path) -> tuple[float, float]:
    """Seconds until READY=1, and of CPU time until the service has ended again."""
    (folder / "run.toml").write_text(_CONFIG)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(folder / "notify"))
        systemd.settimeout(_PATIENCE_S)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        begun = time.monotonic()
        service = subprocess.Popen(
            [sys.executable, "-m", "artemis_edge.cli", "run", "--config", "run.toml"],
            cwd=folder,
            env={**os.environ, "NOTIFY_SOCKET": str(folder / "notify")},
            stderr=subprocess.DEVNULL,
        )
        try:
            while systemd.recv(4096) != b"READY=1":
                pass
            ready = time.monotonic() - begun
        finally:
            service.send_signal(signal.SIGTERM)
            service.wait(_PATIENCE_S)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return ready, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Print the times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=5)
    found = []
    for _ in range(parser.parse_args().times):
        with tempfile.TemporaryDirectory() as name:
            found.append(once(Path(name)))
    ready, cpu = zip(*found, strict=True)
    print(f"READY after {statistics.median(ready):.2f} s (at most {max(ready):.2f}; asked 10)")
    print(f"CPU {statistics.median(cpu):.2f} s until it has ended again")


if __name__ == "__main__":
    main()
