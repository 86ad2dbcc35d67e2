"""How much the mapping may do: the order in which it gives way when it falls behind, the machine is hot or the battery
low (the message of topics.OVERLOAD).

Recording is never among it. Each step keeps what those before it took away: first the preview, then texture, then how
often images are segmented, then the sweeps of the constraint, last the density of points.
"""

from __future__ import annotations

import msgspec
from msgspec import Struct


class Load(Struct, frozen=True):
    """What is allowed. ``preview_hz`` and ``segmentation_hz`` 0: without bound; of points every ``every_point``-th."""

    level: int = 0
    preview_hz: float = 0.0
    texture_share: float = 1.0
    segmentation_hz: float = 0.0
    most_sweeps: int = 20
    every_point: int = 1
    why: str = ""

    @classmethod
    def decode(cls, text: str) -> Load:
        """From the text of a message; ValueError where it is none."""
        try:
            load = msgspec.json.decode(text, type=cls)
        except msgspec.MsgspecError as error:
            raise ValueError(str(error)) from None
        if load.every_point < 1 or not 0.0 < load.texture_share <= 1.0 or load.most_sweeps < 0:
            raise ValueError("a load beyond its limits")
        return load

    def plain(self) -> dict[str, object]:
        """What is written."""
        return dict(msgspec.to_builtins(self))

    def reduced(self) -> list[str]:
        """What is less than it might be, for the display."""
        found = []
        if self.preview_hz > 0.0:
            found.append(f"preview {self.preview_hz:g} Hz")
        if self.texture_share < 1.0:
            found.append(f"texture {self.texture_share:.0%}")
        if self.segmentation_hz > 0.0:
            found.append(f"masks {self.segmentation_hz:g} Hz")
        if self.most_sweeps < Load().most_sweeps:
            found.append(f"sweeps {self.most_sweeps}")
        if self.every_point > 1:
            found.append(f"points 1/{self.every_point}")
        return found


#: The order of giving way.
LADDER = (
    Load(),
    Load(1, 2.0),
    Load(2, 1.0),
    Load(3, 1.0, 0.5),
    Load(4, 1.0, 0.1),
    Load(5, 1.0, 0.1, 2.0),
    Load(6, 1.0, 0.1, 0.5),
    Load(7, 1.0, 0.1, 0.5, 1),
    Load(8, 1.0, 0.1, 0.5, 0),
    Load(9, 1.0, 0.1, 0.5, 0, 2),
    Load(10, 1.0, 0.1, 0.5, 0, 4),
)
#: The step up to which warmth and a low battery go: they are no reason for a worse map.
SAVING = 6
