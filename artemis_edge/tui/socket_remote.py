"""The service behind its control socket (docs/control-socket.md), as the terminal wants it."""

from __future__ import annotations

import json
import socket
import threading
from pathlib import Path
from typing import Any

from artemis_edge.frames import MeshDelta
from artemis_edge.status import MapStatus, QueryStatus, State, Status, Stream, SyncStatus
from artemis_edge.tui.remote import RemoteError

_ANSWER_S = 3.0
_MOST_ANSWER = 1 << 22
_EXPECTED_HZ = {"lidar": 0.0, "cam": 10.0}
_STATES: dict[str, State] = {
    "idle": "idle", "checking": "checking", "recording": "recording", "saving": "saving", "fault": "fault",
}  # fmt: skip


class SocketRemote:
    """Connects when first asked, and again after the service was away; one request at a time."""

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self._path = path
        self._lock = threading.Lock()
        self._socket: socket.socket | None = None
        self._heard = bytearray()
        self._number = 0

    def status(self) -> Status:
        """The state as the service tells it."""
        return to_status(self._ask({"do": "status"}))

    def deltas(self) -> list[MeshDelta]:
        """The control socket carries no mesh."""
        return []

    def ask(self, text: str) -> str:
        """Add a live question."""
        self._ask({"do": "ask", "text": text})
        return f"looking for '{text}'"

    def forget(self, text: str) -> str:
        """Remove a live question."""
        self._ask({"do": "forget", "text": text})
        return f"'{text}' is no longer looked for"

    def command(self, name: str) -> str:
        """start, stop or mark."""
        found = self._ask({"do": name})
        return (
            f"marked, number {found['number']}"
            if name == "mark"
            else f"the service is {found.get('phase', '')}"
        )

    def close(self) -> None:
        """Detach."""
        with self._lock:
            self._forget_socket()

    def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        with self._lock:
            self._number += 1
            line = json.dumps({"v": 1, "id": self._number, **request}).encode() + b"\n"
            try:
                answer = self._exchange(line)
            except (OSError, ValueError) as error:
                self._forget_socket()
                raise RemoteError(_sentence(self._path, error)) from None
        if not answer.get("ok"):
            raise RemoteError(str(answer.get("error", "the service refused")))
        result: dict[str, Any] = answer["result"]
        return result

    def _exchange(self, line: bytes) -> dict[str, Any]:
        if self._socket is None:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            self._socket.settimeout(_ANSWER_S)
            self._socket.connect(str(self._path))
            self._heard.clear()
        self._socket.sendall(line)
        while True:
            while (end := self._heard.find(b"\n")) < 0:
                data = self._socket.recv(1 << 16)
                if not data or len(self._heard) > _MOST_ANSWER:
                    raise ConnectionResetError("the service closed the connection")
                self._heard += data
            answer = json.loads(bytes(self._heard[:end]))
            del self._heard[: end + 1]
            if isinstance(answer, dict) and answer.get("id") == self._number:
                return answer

    def _forget_socket(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket = None


def _sentence(path: Path, error: OSError | ValueError) -> str:
    if isinstance(error, FileNotFoundError | ConnectionRefusedError):
        return f"no service listens at {path}; start it with: artemis-edge run"
    if isinstance(error, PermissionError):
        return f"you may not use {path}; join the service's group, or ask its administrator"
    if isinstance(error, TimeoutError):
        return f"the service at {path} does not answer; see its journal"
    return f"the connection to {path} broke ({error}); trying again"


def to_status(state: dict[str, Any]) -> Status:
    """The service's state as a Status; what it does not tell stays unknown."""
    session = state.get("session") or {}
    mapping = session.get("mapping") or {}
    devices = state.get("devices") or []
    lost = {str(k): int(v) for k, v in (state.get("lost") or {}).items() if v}
    lost |= {f"mapping_{k}": int(v) for k, v in (mapping.get("lost") or {}).items() if v}
    ended = state.get("ended") or []
    folder = str(session.get("folder") or (ended[-1].get("folder", "") if ended else ""))
    report = Path(folder) / "map" / "report.html" if folder else None
    events = [e.get("message") for e in state.get("events") or [] if e.get("message")]
    return Status(
        state=_STATES.get(str(state.get("phase")), "idle"),
        message=str(state.get("fault") or (events[-1] if events else "")),
        seconds=float(session.get("seconds") or 0.0),
        session=folder,
        frames=int(mapping.get("frames") or 0),
        dropped=int(mapping.get("dropped") or 0),
        streams=[_stream(d, session) for d in devices],
        sync=_sync(state),
        map=MapStatus(
            int(mapping.get("vertices") or 0), int(mapping.get("triangles") or 0),
            float(mapping.get("area_m2") or 0.0), float(mapping.get("resident_mb") or 0.0),
        ),
        frame_ms=[float(v) for v in mapping.get("frame_ms") or []],
        disk_minutes=(state.get("disk") or {}).get("minutes_left"),
        battery_minutes=(state.get("battery") or {}).get("minutes_left"),
        overload=[str(v) for v in mapping.get("overload") or []],
        degenerate=bool(mapping.get("degenerate")),
        coaching=[str(v) for v in mapping.get("coaching") or []],
        losses=lost,
        queries=[_query(q) for q in mapping.get("queries") or state.get("queries") or []],
        position=tuple((mapping.get("position") or (0.0, 0.0, 0.0))[:3]),
        yaw=float(mapping.get("yaw") or 0.0),
        report=str(report) if report is not None and report.exists() else "",
    )  # fmt: skip


def _stream(device: dict[str, Any], session: dict[str, Any]) -> Stream:
    counters = device.get("counters") or {}
    lost = sum(int(v) for k, v in counters.items() if "lost" in k or "dropped" in k)
    return Stream(
        name=str(device.get("name")),
        hz=float((device.get("status") or {}).get("rate_hz") or 0.0),
        lost=lost,
        age_s=float(device.get("age_s") or 0.0),
        state=str(device.get("state")),
        message=str(device.get("message") or ""),
    )


def _sync(state: dict[str, Any]) -> SyncStatus:
    clocks = state.get("clocks") or {}
    words = {str(c.get("state")) for c in clocks.values() if isinstance(c, dict) and c.get("state")}
    skews = {
        str(name): float(c["skew_ppm"])
        for name, c in clocks.items()
        if isinstance(c, dict) and c.get("skew_ppm")
    }
    if not clocks:
        return SyncStatus()
    return SyncStatus("holdover" if "holdover" in words else "locked", 0.0, skews)


def _query(query: Any) -> QueryStatus:
    if isinstance(query, str):
        return QueryStatus(query)
    return QueryStatus(
        str(query.get("text")), str(query.get("status", "searching")), int(query.get("count") or 0),
        float(query.get("score") or 0.0), places=[tuple(p) for p in query.get("places") or []],
    )  # fmt: skip
