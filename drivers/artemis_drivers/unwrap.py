"""Counters and clocks of devices have few bits; here they get the ones that are missing."""

from __future__ import annotations


def wrapped_step(before: int, after: int, modulus: int, expected: int = 0) -> int:
    """How far a number that wraps at ``modulus`` went: of all possible steps the one nearest ``expected``."""
    half = modulus // 2
    return expected + (after - before - expected + half) % modulus - half


class Unwrap:
    """Makes a wrapping number (counter, clock ticks) count on.

    ``modulus`` is the number of states, 2**16 for a u16. The next value is taken to be within half a turn of
    what is expected: of the last one, or of the last one plus ``advance`` where somebody knows how much must
    have passed (then gaps of any length are bridged). Values may also go back, e.g. of a reordered message.
    """

    def __init__(self, modulus: int) -> None:
        if modulus < 2:
            raise ValueError(f"a counter with {modulus} states cannot wrap")
        self.modulus = modulus
        self.last: int | None = None

    def __call__(self, raw: int, advance: int = 0) -> int:
        """The unwrapped value of ``raw`` (taken modulo ``modulus``); the first one is itself."""
        if self.last is None:
            self.last = raw % self.modulus
        else:
            self.last += wrapped_step(self.last, raw, self.modulus, advance)
        return self.last

    def reset(self) -> None:
        """Forget: the next value is itself."""
        self.last = None
