"""One session: its folder, the recorder and the mapping, and what is done when one of them dies."""

from __future__ import annotations

import base64
import os
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

from artemis_edge import config as mapping_config
from artemis_edge import topics
from artemis_edge.errors import InputError
from artemis_edge.orphans import adopt_orphans
from artemis_edge.service import settings
from artemis_edge.service.children import Child
from artemis_edge.service.control import control_path, viewers_path
from artemis_edge.service.mapper_task import MapperTask
from artemis_edge.service.outlet import Outlet, rig_topics
from artemis_edge.service.overload import Machine, OverloadControl
from artemis_edge.service.questions import Restarts
from artemis_edge.service.segmenter_task import SegmenterTask
from artemis_edge.service.settings import RunConfig
from artemis_edge.session.asked import Asked
from artemis_edge.session.messages import Mask
from artemis_edge.session.recorder import RecorderTask
from artemis_edge.session.results import clear_left, remove_empty
from artemis_edge.session.verify import CONFIG_NAME

RESULT = "result"
_MB = 1_000_000
_MOST_RESTARTS = 5
_MAPPING_NICE = 5  # capture and recording go first
_SEGMENTER_NICE = 10  # it may have what the mapping leaves: late by design
_JUDGE_S = 0.25

#: Told of what happened: an event for the session, the log and the clients.
Tell = Callable[[dict[str, Any]], None]


class LiveSession:
    """``begin`` it, ``turn`` often, ``end`` it, ``turn`` until it is ``over``. ``fault`` is a sentence, or empty."""

    def __init__(
        self,
        config: RunConfig,
        folder: Path,
        outlet: Outlet,
        tell: Tell,
        about: dict[str, Any],
        go_on: bool = False,
        asked: Asked | None = None,
    ) -> None:
        """``go_on``: its map continues the one that the folder has, if any. ``asked`` are the questions to begin with,
        None where the map is to have no classes."""
        self.config, self.folder, self.outlet, self.asked = config, folder, outlet, asked
        self.fault = ""
        self.begun_s = time.monotonic()
        self.ended_s: float | None = None
        self.recorder_restarts = self.mapper_restarts = 0
        self._tell, self._about, self._go_on = tell, about, go_on
        self._first = self._stop_at = 0
        self._out = folder / RESULT
        self._adopted: set[int] = set()
        self.recorder_last: dict[str, Any] = {}
        self.mapper_last: dict[str, Any] = {}
        self.recorder: Child | None = None
        self.mapper: Child | None = None
        self.segmenter: Child | None = None
        self.segmenter_last: dict[str, Any] = {}
        self._segmenter_restarts = Restarts()
        service = config.service
        self.control = OverloadControl(service.hot_c, service.low_battery_percent)
        self.machine = Machine()
        self._judged_s = 0.0

    def begin(self) -> None:
        """From now on everything is recorded; InputError if the folder cannot be made."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"cannot make the session {self.folder}: {error.strerror}; choose another --session"
            ) from None
        adopt_orphans()
        self._out = result_folder(self.folder)
        self._first = self.outlet.open(
            self.config, self._about, None if self.asked is None else self.asked.plain()
        )
        self.recorder = self._start_recorder()
        if self.config.service.mapping:
            self.mapper = self._start_mapper()
            if self.asked is not None:
                self.segmenter = self._start_segmenter(self.asked)

    def ask(self, asked: Asked) -> None:
        """What is looked for from now on: for the recording and the mapping a message, for the network an order."""
        self.asked = asked
        self.outlet.say(topics.QUESTIONS.name, asked.plain())
        if self.segmenter is not None:
            self.segmenter.tell("asked", asked=asked.plain())

    def end(self) -> None:
        """No more messages: what there is will be written and mapped."""
        if self.ended_s is None:
            self.ended_s = time.monotonic()
            self._end_segmenter()
            self._stop_at = self.outlet.close()
            for child in (self.recorder, self.mapper):
                if child is not None:
                    child.tell("stop", at=self._stop_at)

    @property
    def over(self) -> bool:
        """Whether all is written."""
        return self.ended_s is not None and self.recorder is None and self.mapper is None

    def turn(self) -> None:
        """Hear the processes; start again what has died."""
        self._reap()
        if self.recorder is not None:
            self.recorder.hear()
            if not self.recorder.alive:
                self._recorder_ended(self.recorder)
        if self.segmenter is not None:
            self._hear_segmenter(self.segmenter)
        if self.mapper is not None and self.ended_s is None and self.config.service.overload:
            self._judge_load(self.mapper.latest)
        if self.mapper is not None:
            for line in self.mapper.hear():
                self._mapper_says(line)
            if self.mapper.channel.closed:
                self._mapper_ended(self.mapper)

    def hurry(self) -> None:
        """Give up the map; the recording is closed all the same."""
        if self.mapper is not None:
            self._kill_mapper(self.mapper)
            self.mapper = None
            clear_left(self._out)
            remove_empty([self._out])
            self.fault = (
                self.fault or "the map was not saved; 'artemis-edge replay' makes it from the recording"
            )

    def state(self) -> dict[str, Any]:
        """How both do."""
        until = self.ended_s or time.monotonic()
        return {
            "folder": str(self.folder),
            "report": str(report) if self.over and (report := self._out / "report.html").exists() else "",
            "seconds": round(until - self.begun_s, 1),
            "recorder": self.recorder.latest if self.recorder is not None else self.recorder_last,
            "recorder_restarts": self.recorder_restarts,
            "mapping": self.mapper.latest if self.mapper is not None else self.mapper_last,
            "mapping_restarts": self.mapper_restarts,
            "segmentation": self.segmenter.latest if self.segmenter is not None else self.segmenter_last,
            "fault": self.fault,
            "reduced": self.control.load.reduced(),
            "temperature_c": self.machine.temperature_c,
            "battery_minutes": self.machine.minutes,
        }

    def _start_recorder(self, *, resume: bool = False) -> Child:
        s = self.config.service
        task = RecorderTask(
            str(self.folder),
            self._first,
            {
                "run.toml": settings.to_toml(self.config),
                CONFIG_NAME: mapping_config.to_toml(self.config.mapping),
            },
            {"session": {name: str(value) for name, value in self._about.items()}},
            s.split_mb * _MB,
            s.reserve_mb * _MB,
            resume,
        )
        return Child("artemis_edge.session.recorder", [self.outlet.ring.descriptor], task)

    def _start_mapper(self) -> Child:
        task = MapperTask(
            str(self.folder),
            str(self._out),
            self._first,
            mapping_config.to_toml(self.config.mapping),
            self.config.service.checkpoint_s,
            str(viewers_path(control_path(self.config.service.socket))),
            int(self.config.service.socket_mode, 8),
            str(self.folder) if self._go_on else "",
            self.asked is not None,
        )
        child = Child("artemis_edge.service.mapper", [self.outlet.ring.descriptor], task, _MAPPING_NICE)
        if self.ended_s is not None:
            child.tell("stop", at=self._stop_at)
        return child

    def _judge_load(self, mapping: dict[str, Any]) -> None:
        """Let the mapping do less while it is too much; the decision is a message of the session."""
        now = time.monotonic()
        if now - self._judged_s < _JUDGE_S or mapping.get("state") != "mapping":
            return
        self._judged_s = now
        self.machine.look(now)
        reached = mapping.get("load", 0) == self.control.load.level
        readings = self.machine.readings(float(mapping.get("behind_s", 0.0)), reached)
        load = self.control.look(now, readings)
        if load is None:
            return
        self.outlet.say(topics.OVERLOAD.name, load.plain())
        if self.segmenter is not None:
            self.segmenter.tell("rate", hz=load.segmentation_hz)
        what = ", ".join(load.reduced()) or "nothing"
        self._tell({"kind": "overload", "level": load.level, "message": f"{load.why}; reduced: {what}"})

    def _start_segmenter(self, asked: Asked) -> Child:
        rule = self.config.mapping.segmentation
        task = SegmenterTask(
            rig_topics(self.config).cameras,
            asked,
            rule.least_score,
            rule.overlap,
            rule.most_hz,
            str(viewers_path(control_path(self.config.service.socket))),
        )
        child = Child("artemis_edge.service.segmenter", [self.outlet.ring.descriptor], task, _SEGMENTER_NICE)
        child.tell("rate", hz=self.control.load.segmentation_hz)
        return child

    def _hear_segmenter(self, child: Child) -> None:
        """Its masks are sent like what a device measures; dead, another takes its place, and the map goes on."""
        for line in child.hear():
            if "mask" in line:
                self._send_mask(line["mask"])
        if child.alive:
            return
        why = str(child.latest.get("fault", "")) or f"its process ended ({child.process.returncode})"
        self._end_segmenter()
        failed = self.segmenter_last.get("state") == "failed"
        if not failed and self.asked is not None and self._segmenter_restarts.allowed():
            self.segmenter = self._start_segmenter(self.asked)
        self._tell({"kind": "warning", "message": f"no masks from the network: {why}"})

    def _send_mask(self, text: str) -> None:
        mask = Mask.decode(base64.b64decode(text))
        self.outlet.send(topics.MASKS.name, mask, mask.header.stamp_ns)

    def _end_segmenter(self) -> None:
        if self.segmenter is None:
            return
        child, self.segmenter = self.segmenter, None
        self.segmenter_last = child.latest
        child.process.kill()
        child.end(0.0)

    def _recorder_ended(self, child: Child) -> None:
        """Ended in order, or died: then another one goes on where the last one's file ends."""
        child.hear()
        self.recorder_last, self.recorder = child.latest, None
        child.end(0.0)
        if child.latest.get("full"):
            self.fault = self.fault or str(child.latest["full"])
        elif child.process.returncode != 0 and self.recorder_restarts < _MOST_RESTARTS:
            self.recorder_restarts += 1
            self.recorder = self._start_recorder(resume=True)
            if self.ended_s is not None:
                self.recorder.tell("stop")
            why = f"exit code {child.process.returncode}"
            message = f"the recorder ended ({why}); another goes on in a new file, where that one's ends"
            self._tell({"kind": "recorder_restarted", "message": message})
        elif child.process.returncode != 0:
            self.fault = self.fault or "the recorder keeps ending; see the log"

    def _mapper_says(self, line: dict[str, Any]) -> None:
        if line.get("resumed"):
            assert self.mapper is not None
            self._adopted.add(int(line["pid"]))
            self.mapper_restarts += 1
            frame = int(line.get("frames", 0))
            message = f"the mapping ended and goes on from frame {frame}; nothing recorded is lost"
            self._tell({"kind": "mapping_restarted", "frame": frame, "message": message})
        if line.get("state") in ("saved", "failed") and line.get("fault"):
            self.fault = self.fault or str(line["fault"])

    def _mapper_ended(self, child: Child) -> None:
        """Process and copies are gone: in order, or all died, then it is mapped anew from the recording."""
        self.mapper_last, self.mapper = child.latest, None
        child.end(5.0)
        state = child.latest.get("state")
        if state in ("saved", "failed"):
            return
        if self.mapper_restarts < _MOST_RESTARTS:
            self.mapper_restarts += 1
            self.mapper = self._start_mapper()
            self._tell(
                {"kind": "mapping_restarted", "frame": 0, "message": "the mapping ended and begins anew"}
            )
        else:
            self.fault = (
                self.fault or "the mapping keeps ending; recording goes on, map it later with reprocess"
            )

    def _kill_mapper(self, child: Child) -> None:
        """Its channel closed, the copy that takes over finds nobody and ends."""
        child.channel.socket.close()
        child.channel.closed = True
        child.process.kill()
        child.process.wait()

    def _reap(self) -> None:
        """Copies of the mapping that took over and have ended are our children by adoption."""
        for pid in [*self._adopted]:
            try:
                ended = os.waitpid(pid, os.WNOHANG)[0]
            except ChildProcessError:
                ended = pid
            if ended:
                self._adopted.discard(pid)


def result_folder(session: Path) -> Path:
    """Where the map goes: ``result``, of a session that was continued ``result_2`` and so on."""
    folder, number = session / RESULT, 2
    while folder.exists():
        folder, number = session / f"{RESULT}_{number}", number + 1
    return folder


def session_folder(sessions: Path, now: datetime) -> Path:
    """A folder that is not there yet, named by the time."""
    stem = now.strftime("%Y-%m-%d_%H-%M-%S")
    folder, number = sessions / stem, 2
    while folder.exists():
        folder, number = sessions / f"{stem}_{number}", number + 1
    return folder
