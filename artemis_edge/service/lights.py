"""LED and buzzer of the trigger board: patterns by state, told again whenever the board shows something else."""

from __future__ import annotations

import time
from enum import StrEnum

from artemis_drivers.trigger.board import TriggerBoard
from artemis_drivers.trigger.messages import Opcode


class Phase(StrEnum):
    """What the service does."""

    IDLE = "idle"
    CHECKING = "checking"
    RECORDING = "recording"
    SAVING = "saving"
    FAULT = "fault"


#: Patterns of the LED (0 is off) and of the buzzer (sounded once); what each looks like is the firmware's.
LED = {Phase.IDLE: 1, Phase.CHECKING: 2, Phase.RECORDING: 3, Phase.SAVING: 4, Phase.FAULT: 5}
BUZZER = {Phase.RECORDING: 1, Phase.SAVING: 2, Phase.FAULT: 3}
MARKED = 4
_AGAIN_S = 1.0  # the board tells what it shows once a second


class Lights:
    """``show`` a state, ``turn`` often: a board that was away, or restarted, gets it again."""

    def __init__(self, board: TriggerBoard | None) -> None:
        self._board = board
        self._led = LED[Phase.IDLE]
        self._told_s = float("-inf")

    def show(self, phase: Phase) -> None:
        """The patterns of a state."""
        self._led = LED[phase]
        self._send(BUZZER.get(phase, 0))

    def marked(self) -> None:
        """A moment was marked: heard, not seen."""
        self._send(MARKED)

    def off(self) -> None:
        """Nobody is there any more."""
        self._led = 0
        self._send(0)

    def turn(self) -> None:
        """See that it shows what it should."""
        shown = None if self._board is None else self._board.led_shown
        if shown is not None and shown != self._led and time.monotonic() - self._told_s > _AGAIN_S:
            self._send(0)

    def _send(self, buzzer: int) -> None:
        if self._board is not None and self._board.led_shown is not None:
            self._told_s = time.monotonic()
            self._board.command(Opcode.INDICATE, self._led, buzzer)
