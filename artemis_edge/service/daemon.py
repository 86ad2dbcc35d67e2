"""The service: owns the devices, records and maps sessions, obeys clients, buttons and signals, tells systemd.

States: idle (devices on, nothing recorded), checking (waiting for devices before a recording), recording, saving
(a session is being closed), fault (a device thread of ours has ended: only a restart helps).
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from importlib import metadata
from pathlib import Path
from types import FrameType
from typing import Any

import msgspec
from artemis_drivers.base import DriverError, State
from artemis_drivers.udp import Interface, interfaces

from artemis_edge import health, topics
from artemis_edge.errors import InputError, RunError
from artemis_edge.progress import say
from artemis_edge.segmentation.registry import Registry
from artemis_edge.service.capture import Capture
from artemis_edge.service.control import ControlSocket, control_path
from artemis_edge.service.lights import Lights, Phase
from artemis_edge.service.live_session import LiveSession, session_folder
from artemis_edge.service.notify import Notifier
from artemis_edge.service.outlet import Outlet
from artemis_edge.service.questions import Desk
from artemis_edge.service.rig import Rig, make_rig
from artemis_edge.service.settings import RunConfig
from artemis_edge.service.status_view import StatusView
from artemis_edge.session.feed import next_number
from artemis_edge.session.files import NAME
from artemis_edge.session.message_ring import MessageRing
from artemis_edge.status import QueryStatus

_TURN_S = 0.05
_STATE_AGE_S = 0.1
_CAPTURE_STALE_S = 1.0  # a thread that turns a hundred times a second
_RECORDER_STALE_S = 4.0
_MAPPER_STALE_S = 20.0  # it may be in a long frame, and saving a large map it says nothing
_SAVING_S = 30.0  # what is asked of systemd again and again while saving
_SILENT_S = 60.0  # a recorder that has said nothing for so long is stuck; it speaks as long as it writes
_MARK_LONGEST = 500
_NAME_LONGEST, _NAME_BYTES = 100, 240  # a file system takes 255 bytes
_BUTTON_RECORD, _BUTTON_MARK = 0, 1
_NS = 1e9


@dataclass(frozen=True, slots=True)
class Wanted:
    """What the command line asks for: ``session`` names the folder of the first recording, ``go_on`` an earlier one."""

    session: Path | None = None
    go_on: Path | None = None
    queries: tuple[str, ...] = ()
    seconds: float | None = None


@dataclass(slots=True)
class _Marks:
    """What clients and the log were told lately."""

    events: list[dict[str, Any]] = field(default_factory=list)
    count: int = 0


class Daemon:
    """``run`` until a signal, the end of the time asked for, or a ``quit``. Raises UserError where it cannot begin."""

    def __init__(
        self,
        config: RunConfig,
        wanted: Wanted | None = None,
        own_addresses: Callable[[], list[Interface]] = interfaces,
        log: Callable[[str], None] = say,
    ) -> None:
        self.config, self.wanted = config, wanted or Wanted()
        self.phase = Phase.IDLE
        self.session: LiveSession | None = None
        self.fault = ""
        self._log = log
        self._notify = Notifier()
        self._marks = _Marks()
        self._ended_sessions: list[dict[str, Any]] = []
        self._signals = 0
        self._known: tuple[float, dict[str, Any]] | None = None
        self._quit = False
        self._checking_s = 0.0
        self._folder: Path | None = None
        self._first_recording = True
        try:
            self.rig: Rig = make_rig(config, own_addresses)
        except DriverError as error:
            raise InputError(str(error)) from None
        self.outlet = Outlet(MessageRing.create(config.service.ring_mb, _next_number(self.wanted.go_on)))
        self.capture = Capture(self.rig, self.outlet)
        self._lights = Lights(self.rig.board)
        self._view = StatusView(config)
        self.desk = make_desk(config)
        for text in self.wanted.queries:
            self._asked_for(text)
        self.control = ControlSocket(
            control_path(config.service.socket), int(config.service.socket_mode, 8), self._answer
        )

    def run(self) -> int:
        """Exit code: 0, or 1 where a recording or a map fell short."""
        try:
            self._start()
            self._loop()
            return self._stop()
        finally:
            with contextlib.suppress(OSError):
                self.control.close()

    # --- life ---

    def _start(self) -> None:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._signalled)
        try:
            self.rig.start()
        except DriverError as error:
            raise RunError(str(error)) from None
        self.capture.start()
        self._notify.ready()
        if (
            self.config.service.record_at_start
            or self.wanted.session is not None
            or self.wanted.go_on is not None
        ):
            self._begin_checking(self.wanted.go_on or self.wanted.session)
        self._tell({"kind": "service", "message": f"listening at {self.control.path}"})

    def _loop(self) -> None:
        begun = time.monotonic()
        while not (self._signals or self._quit):
            self._turn()
            if self.wanted.seconds is not None and time.monotonic() - begun > self.wanted.seconds:
                return

    def _turn(self) -> None:
        self.control.turn(self._told, _TURN_S)
        if self.capture.fault is not None and self.phase != Phase.FAULT:
            self._fail(f"the capture thread ended: {self.capture.fault}")
        self._buttons()
        if self.phase == Phase.CHECKING:
            self._check()
        if self.session is not None:
            self.session.turn()
            if self.session.ended_s is None and self._disk_full():
                self._end_session()
            if self.session.over:
                self._close_session(self.session)
        self._lights.turn()
        self._view.look(self.capture.health())
        self._notify.status(self._sentence())
        if self._alive():
            self._notify.beat()

    def _stop(self) -> int:
        """SIGTERM: devices first, then what is on its way, then the files; bounded, a second signal hurries."""
        self._notify.stopping()
        asked = self._signals
        session = self.session
        in_vain = self.phase == Phase.CHECKING
        if in_vain:
            message = f"nothing was recorded: still waiting for {self._missing()} when it was to end"
            self._tell({"kind": "warning", "message": message})
        if session is not None:
            self._lights.show(Phase.SAVING)
        self.rig.stop()
        self.capture.stop()
        if session is not None:
            self._end_session()
        while self.session is not None:
            self._notify.extend(_SAVING_S)
            self._turn()
            if self._signals > asked:
                asked = 1 << 30
                if self.session is not None:
                    self.session.hurry()
            recorder = None if session is None else session.recorder
            if recorder is not None and time.monotonic() - recorder.heard_s > _SILENT_S:
                recorder.process.kill()  # another one goes on, with a time of its own
        self._lights.off()
        self.rig.stop_board()
        short = any(ended["fault"] for ended in self._ended_sessions) or (in_vain and not self._signals)
        return 1 if short or self.fault else 0

    def _signalled(self, number: int, frame: FrameType | None) -> None:
        self._signals += 1

    # --- sessions ---

    def _begin_checking(self, folder: Path | None) -> None:
        self._folder = folder
        self._checking_s = time.monotonic()
        self._become(Phase.CHECKING)

    def _check(self) -> None:
        """Recording begins when all devices run and time is known, or after a while with those that do."""
        ready = self.rig.running() and self.capture.sync is not None and self.capture.windows > 0
        waited = time.monotonic() - self._checking_s
        if not ready and waited < self.config.service.start_patience_s:
            return
        if not ready:
            self._tell({"kind": "warning", "message": f"recording without {self._missing()}"})
        try:
            self._begin_session()
        except InputError as error:
            self._tell({"kind": "warning", "message": str(error)})
            self._become(Phase.IDLE)

    def _missing(self) -> str:
        return ", ".join([h.name for h in self.capture.health() if h.state != State.RUNNING] or ["time"])

    def _begin_session(self) -> None:
        folder = self._folder or session_folder(
            Path(self.config.service.sessions), datetime.now().astimezone()
        )
        go_on = self._first_recording and self.wanted.go_on is not None
        if not go_on and any(folder.glob(NAME.replace("{:03d}", "*"))):
            raise InputError(f"{folder} holds a recording already; give another --session, or --continue it")
        self._first_recording = False
        about = {
            "version": metadata.version("artemis-edge"),
            "begun": datetime.now().astimezone().isoformat(timespec="seconds"),
            "queries": [] if self.desk is None else list(self.desk.asked().texts),
            "devices": {h.name: dict(h.identity) for h in self.capture.health()},
            "applied": {
                h.name: [f"{a.item}={a.read_back} ({a.status})" for a in h.applied]
                for h in self.capture.health()
            },
        }
        asked = None if self.desk is None else self.desk.asked()
        session = LiveSession(self.config, folder, self.outlet, self._tell, about, go_on, asked)
        session.begin()
        self.session = session
        self._become(Phase.RECORDING)

    def _end_session(self) -> None:
        if self.session is not None and self.session.ended_s is None:
            self.session.end()
            self._become(Phase.SAVING)

    def _close_session(self, session: LiveSession) -> None:
        self._ended_sessions.append(session.state())
        self.session = None
        self._become(Phase.IDLE)
        what = session.fault or f"recorded and mapped in {session.folder}"
        self._tell({"kind": "session_closed", "folder": str(session.folder), "message": what})

    def _disk_full(self) -> bool:
        assert self.session is not None
        recorder = self.session.recorder
        if recorder is not None and recorder.latest.get("full"):
            self.session.fault = self.session.fault or str(recorder.latest["full"])
            return True
        return recorder is None

    def _buttons(self) -> None:
        while self.capture.buttons:
            button = self.capture.buttons.pop(0)
            if button == _BUTTON_RECORD:
                if self.phase == Phase.RECORDING:
                    self._end_session()
                elif self.phase == Phase.CHECKING:
                    self._become(Phase.IDLE)
                elif self.phase == Phase.IDLE:
                    self._begin_checking(None)
            elif button == _BUTTON_MARK and self.phase == Phase.RECORDING:
                self._mark("button")
            elif button == _BUTTON_MARK:
                message = f"a mark belongs to a recording: the service is {self.phase}"
                self._tell({"kind": "warning", "message": message})

    def _mark(self, text: str) -> int:
        self._marks.count += 1
        event = {"kind": "mark", "number": self._marks.count, "text": text[:_MARK_LONGEST]}
        self.outlet.say(topics.EVENTS.name, event)
        self._tell(event, recorded=True)
        self._lights.marked()
        return self._marks.count

    # --- what is told ---

    def _become(self, phase: Phase) -> None:
        if phase == self.phase:
            return
        self.phase = phase
        self._known = None
        self._tell({"kind": "state", "state": str(phase)})
        self._lights.show(phase)

    def _fail(self, why: str) -> None:
        self.fault = why
        self._end_session()
        self._become(Phase.FAULT)

    def _tell(self, event: dict[str, Any], *, recorded: bool = False) -> None:
        """To the log, the clients and the session."""
        if not recorded:
            self.outlet.say(topics.EVENTS.name, event)
        self._marks.events = [*self._marks.events[-19:], {**event, "at_s": round(time.time(), 3)}]
        self.control.tell(event)
        self._log(f"<5>{event.get('message') or event}" if "JOURNAL_STREAM" in os.environ else _line(event))

    def _sentence(self) -> str:
        if self.fault:
            return f"fault: {self.fault}"
        if self.session is None:
            return str(self.phase)
        state = self.session.state()
        frames = state["mapping"].get("frames", 0)
        return f"{self.phase} {state['folder']}, {frames} frames mapped"

    def _alive(self) -> bool:
        """Every stage of ours works; that a device is unplugged is no reason for a restart."""
        now = time.monotonic()
        if self.phase == Phase.FAULT or (now - self.capture.turn_s > _CAPTURE_STALE_S and not self._signals):
            return False
        session = self.session
        if session is None or session.ended_s is not None:
            return True
        if session.recorder is not None and now - session.recorder.heard_s > _RECORDER_STALE_S:
            return False
        return session.mapper is None or now - session.mapper.heard_s <= _MAPPER_STALE_S

    def state(self) -> dict[str, Any]:
        """Everything a client may want to know, a tenth of a second old at most, however often it is asked."""
        now = time.monotonic()
        if self._known is None or now - self._known[0] > _STATE_AGE_S:
            self._known = now, self._state()
        return self._known[1]

    def _state(self) -> dict[str, Any]:
        capture, session = self.capture, self.session
        folder = session.folder if session is not None else Path(self.config.service.sessions)
        free_mb = health.free_disk_mb(folder)
        recorder = session.state()["recorder"] if session is not None else {}
        seconds = session.state()["seconds"] if session is not None else 0.0
        rate = recorder.get("bytes", 0) / max(seconds, 1.0)
        left = (free_mb - self.config.service.reserve_mb) * 1e6
        return {
            "phase": str(self.phase),
            "fault": self.fault,
            "session": session.state() if session is not None else None,
            "ended": self._ended_sessions[-5:],
            "devices": [
                {
                    "name": h.name,
                    "state": str(h.state),
                    "message": h.message,
                    "counters": dict(h.counters),
                    "status": dict(h.status),
                    "identity": dict(h.identity),
                    "age_s": round((time.monotonic_ns() - h.last_data_ns) / _NS, 3)
                    if h.last_data_ns
                    else None,
                    "gaps": capture.watch.gaps.get(h.name, 0),
                }
                for h in capture.health()
            ],
            "clocks": capture.clocks(),
            "pairing": capture.counts(),
            "lost": {**capture.lost, **self.outlet.lost},
            "windows": capture.windows,
            "sent": dict(self.outlet.sent),
            "disk": {
                "free_mb": round(free_mb),
                "minutes_left": round(left / rate / 60, 1) if rate > 1000 else None,
            },
            "events": self._marks.events,
            "queries": msgspec.to_builtins(self._questions()),
            "cpu_s": round(time.process_time(), 2),
            "threads_cpu_s": {name: round(s, 3) for name, s in health.cpu_by_thread_s().items()},
        }

    def _told(self) -> dict[str, Any]:
        """What subscribers get."""
        return dict(msgspec.to_builtins(self._view.status(self.state(), self.capture.health())))

    def _answer(self, what: str, request: dict[str, Any]) -> dict[str, Any]:
        """A request of a client."""
        if what == "hello":
            return {"service": "artemis-edge", "version": metadata.version("artemis-edge"), "protocol": 1}
        if what == "state":
            return self.state()
        if what == "status":
            return self._told()
        if what == "start":
            return self._asked_to_start(request)
        if what == "stop":
            if self.phase not in (Phase.RECORDING, Phase.CHECKING):
                raise InputError(f"nothing is being recorded: the service is {self.phase}")
            if self.phase == Phase.CHECKING:
                self._become(Phase.IDLE)
            self._end_session()
            return {"phase": str(self.phase)}
        if what == "mark":
            text = request.get("text", "")
            if not isinstance(text, str):
                raise InputError("the text of a mark is a text")
            if self.phase != Phase.RECORDING:
                raise InputError(f"a mark belongs to a recording: the service is {self.phase}")
            return {"number": self._mark(text)}
        if what == "ask":
            return dict(msgspec.to_builtins(self._asked_for(request.get("text"))))
        if what == "forget":
            self._desk().forget(request.get("text"))
            self._pass_on()
            return {"queries": len(self._desk().asked().texts)}
        if what == "queries":
            return {"queries": msgspec.to_builtins(self._questions())}
        if what == "quit":
            self._quit = True
            return {"phase": str(self.phase)}
        raise InputError(
            f"no request '{what[:40]}'; there are hello, status, state, start, stop, mark, ask, forget, queries, "
            "subscribe, quit"
        )

    # --- questions ---

    def _desk(self) -> Desk:
        if self.desk is None:
            raise InputError(
                "live questions need a camera, mapping = true and questions = true in [service]; "
                "'artemis-edge ask' asks a finished map"
            )
        return self.desk

    def _asked_for(self, text: object) -> QueryStatus:
        status = self._desk().ask(text)
        self._pass_on()
        return status

    def _pass_on(self) -> None:
        """What is asked from now on, to the session that is recorded."""
        self._known = None
        if self.session is not None and self.session.ended_s is None:
            self.session.ask(self._desk().asked())

    def _questions(self) -> list[QueryStatus]:
        if self.desk is None:
            return []
        segmentation = None if self.session is None else self.session.state()["segmentation"]
        return self.desk.told(segmentation)

    def _asked_to_start(self, request: dict[str, Any]) -> dict[str, Any]:
        if self.phase != Phase.IDLE:
            raise InputError(f"the service is {self.phase}: wait until it is idle")
        name = request.get("name")
        if name is not None and not _plain_name(name):
            raise InputError(
                f"the name of a session is a plain name of up to {_NAME_LONGEST} characters ({_NAME_BYTES} bytes), "
                "without folders and control characters"
            )
        folder = None if name is None else Path(self.config.service.sessions) / name
        if folder is not None and folder.exists():
            raise InputError(f"{folder} is there already; give another name")
        self._begin_checking(folder)
        return {"phase": str(self.phase)}


def _plain_name(name: object) -> bool:
    """Whether a folder can be called so on every file system: neither control characters nor half characters."""
    return (
        isinstance(name, str)
        and name.isprintable()
        and 0 < len(name) <= _NAME_LONGEST
        and len(name.encode()) <= _NAME_BYTES
        and Path(name).name == name
    )


def make_desk(config: RunConfig) -> Desk | None:
    """Where questions are asked; None without cameras, mapping, or where they are switched off."""
    if not (config.camera and config.service.mapping and config.service.questions):
        return None
    return Desk(Registry().find(config.mapping.segmentation.model).manifest)


def _next_number(session: Path | None) -> int:
    """After the last message of a session that is to be continued."""
    return 0 if session is None else next_number(session, 0)


def _line(event: dict[str, Any]) -> str:
    rest = {key: value for key, value in event.items() if key not in ("kind", "message")}
    return f"{event['kind']}: {event.get('message') or rest}"
