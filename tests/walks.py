"""The walk that a soak test plays: one that was recorded before, or one through the virtual street."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from artemis_edge.session.simulate import simulate

_WITHOUT_TRUTH = dict.fromkeys(("reference", "point_truth", "mesh"), "off")


@contextmanager
def given_or_simulated(session: Path | None, seconds: float) -> Iterator[tuple[Path, Path]]:
    """The session, simulated where none is given, and a folder for what comes of it, gone afterwards."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        if session is None:
            session = folder / "walk"
            simulate("street", 1, seconds, "avia", session, _WITHOUT_TRUTH)
        yield session, folder
