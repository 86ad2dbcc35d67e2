"""Headless Chromium, driven over its DevTools protocol, and pages of a folder served on this machine."""

import base64
import json
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
# Software rendering: the same pixels on every machine, with or without a graphics card. No host has an address
# but this machine: what needs the internet fails.
_OPTIONS = [
    "--headless=new", "--no-sandbox", "--hide-scrollbars", "--disable-dev-shm-usage", "--no-first-run",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking",
    "--force-device-scale-factor=1", "--disable-component-update", "--disable-sync",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1", "--remote-debugging-port=0",
]  # fmt: skip
_PATIENCE_S = 120.0
_BUSY = -32000  # the protocol's answer while there is no page to ask


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


class Page:
    """One page of a browser. ``requested`` are the addresses it has asked for, ``failed`` those it did not get."""

    def __init__(self, socket: Any) -> None:
        self.requested: list[str] = []
        self.failed: list[str] = []
        self._socket, self._number = socket, 0

    def call(self, method: str, **given: Any) -> dict[str, Any]:
        """A command of the DevTools protocol and its result; while a page is being replaced, asked again."""
        end = time.monotonic() + _PATIENCE_S
        while True:
            answer = self._ask(method, given)
            if "error" not in answer:
                result: dict[str, Any] = answer["result"]
                return result
            assert answer["error"]["code"] == _BUSY and time.monotonic() < end, answer
            time.sleep(0.2)

    def _ask(self, method: str, given: dict[str, Any]) -> dict[str, Any]:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": given}))
        while True:
            message: dict[str, Any] = json.loads(self._socket.recv(timeout=_PATIENCE_S))
            self._note(message)
            if message.get("id") == self._number:
                return message

    def evaluate(self, expression: str) -> Any:
        """Value of an expression in the page."""
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        return result["result"].get("value")

    def picture(self, out: Path | None = None) -> np.ndarray:
        """RGB uint8 (h, w, 3) of what is to be seen."""
        content = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        if out is not None:
            out.write_bytes(content)
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))

    def click(self, x: float, y: float) -> None:
        """Press and release the mouse."""
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def write(self, text: str) -> None:
        """Type a text where the cursor is."""
        self.call("Input.insertText", text=text)

    def until(self, done: Callable[[], Any], what: str) -> Any:
        """Wait until ``done`` gives something true."""
        end = time.monotonic() + _PATIENCE_S
        while time.monotonic() < end:
            if value := done():
                return value
            time.sleep(0.2)
        raise AssertionError(f"waited in vain for {what}")

    def _note(self, message: dict[str, Any]) -> None:
        given = message.get("params", {})
        if message.get("method") == "Network.requestWillBeSent":
            self.requested.append(given["request"]["url"])
        if message.get("method") == "Network.loadingFailed" and not given.get("canceled"):
            self.failed.append(given["errorText"])


@contextmanager
def page(url: str, folder: Path, width: int, height: int) -> Iterator[Page]:
    """A page of a fresh browser whose files lie in ``folder``."""
    from websockets.sync.client import connect

    assert CHROMIUM is not None
    profile = folder / "profile"
    command = [CHROMIUM, *_OPTIONS, f"--user-data-dir={profile}", "about:blank"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        port = _port(profile / "DevToolsActivePort")
        with connect(f"ws://127.0.0.1:{port}{_target(port)}", max_size=None) as socket:
            shown = Page(socket)
            for domain in ("Page", "Network", "Runtime"):
                shown.call(f"{domain}.enable")
            metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
            shown.call("Emulation.setDeviceMetricsOverride", **metrics)
            shown.call("Page.navigate", url=url)
            yield shown
    finally:
        process.terminate()
        process.wait(timeout=_PATIENCE_S)


def _port(file: Path) -> int:
    end = time.monotonic() + _PATIENCE_S
    while time.monotonic() < end:
        if file.is_file() and (lines := file.read_text().split()):
            return int(lines[0])
        time.sleep(0.1)
    raise AssertionError("Chromium does not start")


def _target(port: int) -> str:
    from urllib.request import urlopen

    with urlopen(f"http://127.0.0.1:{port}/json/list", timeout=_PATIENCE_S) as answer:
        targets = json.load(answer)
    url: str = next(t["webSocketDebuggerUrl"] for t in targets if t["type"] == "page")
    return "/" + url.split("/", 3)[3]
