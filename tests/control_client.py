"""A client of the control socket, as plain as can be."""

import json
import socket
from typing import Any


def ask(path: object, **request: Any) -> dict[str, Any]:
    """One request on a connection of its own; the answer."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
        sock.settimeout(40.0)
        sock.connect(str(path))
        sock.sendall(json.dumps({"v": 1, "id": 1, **request}).encode() + b"\n")
        data = b""
        while not data.endswith(b"\n"):
            part = sock.recv(1 << 16)
            if not part:
                break
            data += part
    return dict(json.loads(data))
