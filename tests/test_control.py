"""The control socket: several clients, hostile ones too, and nobody whom the file mode does not let in."""

from __future__ import annotations

import json
import os
import socket
import stat
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from artemis_edge.errors import InputError
from artemis_edge.service.control import MOST_CLIENTS, MOST_LINE, ControlSocket, default_path
from tests.control_client import ask


def _answer(what: str, request: dict[str, Any]) -> dict[str, Any]:
    if what == "echo":
        return {"said": request.get("text")}
    raise InputError(f"no request '{what}'")


@pytest.fixture
def control(tmp_path: Path) -> Iterator[ControlSocket]:
    def answer(what: str, request: dict[str, Any]) -> dict[str, Any]:
        if what == "shout":
            for _ in range(300):
                served.tell({"kind": "mark", "text": "x" * 500})
        return _answer(what, request) if what != "shout" else {"shouted": 300}

    served = ControlSocket(tmp_path / "run" / "artemis.sock", 0o600, answer)
    ended = threading.Event()

    def serve() -> None:
        while not ended.is_set():
            served.turn(lambda: {"phase": "idle"}, 0.01)

    thread = threading.Thread(target=serve)
    thread.start()
    yield served
    ended.set()
    thread.join()
    served.close()
    assert not served.path.exists()


def _connect(control: ControlSocket) -> socket.socket:
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    sock.settimeout(5.0)
    sock.connect(str(control.path))
    return sock


def _lines(sock: socket.socket, count: int) -> list[dict[str, Any]]:
    with sock.makefile() as stream:
        return [json.loads(stream.readline()) for _ in range(count)]


def test_requests_and_refusals(control: ControlSocket) -> None:
    assert ask(control.path, do="echo", text="ä") == {"v": 1, "id": 1, "ok": True, "result": {"said": "ä"}}
    refused = ask(control.path, do="dance")
    assert (refused["ok"], refused["error"]) == (False, "no request 'dance'")
    assert "version 1" in ask(control.path, do="echo", v=2)["error"]


def test_only_its_owner_may_connect(control: ControlSocket) -> None:
    assert stat.S_IMODE(control.path.stat().st_mode) == 0o600
    if os.getuid() != 0:
        return
    pid = os.fork()
    if pid == 0:  # nobody
        os.setgid(65534)
        os.setuid(65534)
        try:
            _connect(control)
        except PermissionError:
            os._exit(7)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 7


def test_subscribers_get_states_and_events_and_never_hold_others_up(control: ControlSocket) -> None:
    deaf, keen = _connect(control), _connect(control)
    for sock in (deaf, keen):
        sock.sendall(b'{"do":"subscribe","every_s":0.05}\n')
    first, second = _lines(keen, 2)
    assert first["result"] == {"every_s": 0.05} and second["event"] == "status"
    ask(control.path, do="shout")
    assert ask(control.path, do="echo", text="still here")["ok"]
    assert any(line["event"] == "event" for line in _lines(keen, 20))
    deaf.close()
    keen.close()


def test_a_client_that_vanishes_is_no_harm(control: ControlSocket) -> None:
    for _ in range(MOST_CLIENTS - 4):
        sock = _connect(control)
        sock.sendall(b'{"do":"subscribe"}\n{"do":"ec')
        sock.close()
    assert ask(control.path, do="echo", text="a")["ok"]


def test_too_long_and_too_many(control: ControlSocket) -> None:
    sock = _connect(control)
    sock.sendall(b"x" * (MOST_LINE + 10))
    assert "at most" in _lines(sock, 1)[0]["error"]
    sock.close()
    crowd = [_connect(control) for _ in range(MOST_CLIENTS + 5)]
    crowd[0].sendall(b'{"do":"echo"}\n')
    assert _lines(crowd[0], 1)[0]["ok"]
    with pytest.raises((OSError, json.JSONDecodeError)):
        crowd[-1].sendall(b'{"do":"echo"}\n')
        _lines(crowd[-1], 1)
    for each in crowd:
        each.close()


@given(st.lists(st.one_of(st.binary(max_size=300), st.just(b"\n"), st.just(b'{"do":"echo"}\n')), max_size=8))
@settings(deadline=None, max_examples=60)
def test_any_bytes_are_survived(lines: list[bytes]) -> None:
    with_path(lambda control: _throw(control, b"".join(lines)))


_VALUES = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text("aä\0{", max_size=3)
    | st.just([{}])
)
_REQUESTS = st.fixed_dictionaries(
    {},
    optional={
        "do": st.sampled_from(["echo", "subscribe", "x"]) | _VALUES,
        "v": _VALUES,
        "id": _VALUES,
        "every_s": _VALUES,
    },
)


@given(_REQUESTS)
@settings(deadline=None, max_examples=60)
def test_any_object_is_answered(request: dict[str, Any]) -> None:
    def check(control: ControlSocket) -> None:
        (answer,) = _throw(control, json.dumps(request).encode() + b"\n")
        assert answer["v"] == 1 and answer["ok"] in (True, False)

    with_path(check)


def with_path(use: Callable[[ControlSocket], object]) -> None:
    """One socket for all examples would be faster, but a fault of one would show in another."""
    path = Path("/tmp") / f"artemis-edge-test-{os.getpid()}" / "s"
    control = ControlSocket(path, 0o600, _answer)
    try:
        use(control)
    finally:
        control.close()
        path.parent.rmdir()


def _throw(control: ControlSocket, data: bytes) -> list[dict[str, Any]]:
    """Send, have it served in this thread, and take what comes back."""
    sock = _connect(control)
    sock.sendall(data)
    for _ in range(6):
        control.turn(lambda: {}, 0.0)
    sock.setblocking(False)
    try:
        heard = sock.recv(1 << 20)
    except BlockingIOError:
        heard = b""
    sock.close()
    control.turn(lambda: {}, 0.0)
    return [json.loads(line) for line in heard.splitlines()]


def test_a_stale_socket_is_replaced_and_a_living_one_is_not(tmp_path: Path) -> None:
    path = tmp_path / "s"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as dead:
        dead.bind(str(path))
    control = ControlSocket(path, 0o660, _answer)
    with pytest.raises(InputError, match="another artemis-edge runs"):
        ControlSocket(path, 0o660, _answer)
    control.close()
    path.write_text("a file of somebody")
    with pytest.raises(InputError, match="no socket"):
        ControlSocket(path, 0o660, _answer)
    with pytest.raises(InputError, match="cannot make the control socket"):
        ControlSocket(path / "below", 0o660, _answer)


def test_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/run/artemis:/run/other")
    assert default_path() == Path("/run/artemis/artemis.sock")
    monkeypatch.delenv("RUNTIME_DIRECTORY")
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/7")
    assert default_path() == Path("/run/user/7/artemis.sock")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert str(os.getuid()) in str(default_path())
