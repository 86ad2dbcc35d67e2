"""What the service tells the mapping process when it starts it; the service itself needs nothing of the pipeline."""

from __future__ import annotations

from msgspec import Struct


class MapperTask(Struct, frozen=True):
    """``config`` as TOML, the session's folder, where the map goes.

    ``viewers`` is the path of the socket for viewers of the growing mesh (empty: none), with its file mode.
    ``earlier`` is where a map may be that this one is to continue (empty: none).
    With ``questions`` the map has classes.
    """

    folder: str
    out: str
    first: int = 0
    config: str = ""
    checkpoint_s: float = 20.0
    viewers: str = ""
    viewers_mode: int = 0o600
    earlier: str = ""
    questions: bool = False
