"""Headless Chromium on pages of a folder served on this machine."""

import os
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
# Software rendering: the same pixels on every machine, with or without a graphics card.
_OPTIONS = [
    "--headless=new", "--no-sandbox", "--hide-scrollbars", "--disable-dev-shm-usage", "--no-first-run",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking",
    "--force-device-scale-factor=1",
]  # fmt: skip


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def serving(folder: Path) -> Iterator[str]:
    """The address under which the files of a folder are served while the block runs."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def screenshot(url: str, out: Path, width: int, height: int, wait_ms: int = 10_000) -> np.ndarray:
    """RGB uint8 (height, width, 3) of a page after ``wait_ms`` of its own time, also written to ``out``."""
    assert CHROMIUM is not None
    profile = out.parent / "profile"
    # a window has a title bar's height less to show than its size says
    command = [
        CHROMIUM, *_OPTIONS, f"--user-data-dir={profile}", f"--window-size={width},{height + 200}",
        f"--virtual-time-budget={wait_ms}", f"--screenshot={out}", url,
    ]  # fmt: skip
    subprocess.run(
        command, check=True, capture_output=True, timeout=300, env=os.environ | {"HOME": str(profile)}
    )
    image = cv2.cvtColor(cv2.imread(str(out)), cv2.COLOR_BGR2RGB)
    return np.asarray(image[:height, :width])
