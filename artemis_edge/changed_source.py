"""A recording of which every frame is changed before anybody sees it."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from artemis_edge.frames import FrameSource, SyncedFrame


class ChangedSource:
    """A FrameSource: ``source``, each frame as ``change`` makes it; everything else is that of ``source``."""

    def __init__(self, source: FrameSource, change: Callable[[SyncedFrame], SyncedFrame]) -> None:
        self.source, self._change = source, change
        self.name, self.stamp_ns, self.poses = source.name, source.stamp_ns, source.poses
        self.input_hz = source.input_hz
        self.lost, self.warnings = (
            source.lost,
            source.warnings,
        )  # the same objects: they grow while it is read

    def __len__(self) -> int:
        return len(self.source)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[SyncedFrame]:
        """Frames ``start <= index < stop``."""
        return (self._change(frame) for frame in self.source.frames(start, stop))
