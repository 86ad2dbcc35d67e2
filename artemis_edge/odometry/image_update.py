"""What the filter asks of a visual update, and when."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from artemis_edge.frames import F32, CameraImage
from artemis_edge.odometry.path import Path
from artemis_edge.odometry.plane_map import PlaneMap
from artemis_edge.odometry.state import State


class SeenScan(NamedTuple):
    """The scan of a frame: thinned ``points`` float32 (n, 3) in the lidar frame at the state's stamp."""

    points: F32


class ImageUpdate(Protocol):
    """Updates a state by the images of a frame, after its LiDAR update; ``lost`` counts by reason.

    In every frame: ``update`` once an image in order of time, with the state that the one before gave; then
    ``remember`` once an image with the frame's final state, so that patches are anchored where the sensor really
    was. The state's stamp is the end of the scan, ``path.at(state, seconds)`` is the pose at an image: seconds
    = (image.stamp_ns - state.stamp_ns) * 1e-9 - state.image_delay_s[camera]. An update returns
    ``iterated_update(state, linearise)``, and the state itself where the image says nothing.
    """

    lost: dict[str, int]

    def update(self, state: State, path: Path, image: CameraImage, scan: SeenScan, planes: PlaneMap) -> State:
        """The state after an image; a camera not yet in the state is added (``State.with_camera``)."""
        ...

    def remember(
        self, state: State, path: Path, image: CameraImage, scan: SeenScan, planes: PlaneMap
    ) -> None:
        """Take new patches from an image at a state that is final for this frame."""
        ...
