"""What is configured on a camera: a hardware-triggered OAK, or files in its place on the bench."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

Socket = Literal["CAM_A", "CAM_B", "CAM_C", "CAM_D"]


class OakSettings(Struct, frozen=True, forbid_unknown_fields=True, tag="oak", tag_field="kind"):
    """One sensor of an OAK-FFC, triggered through its FSIN pin; several sensors of a board are several entries."""

    name: str = "cam_0"
    device: Annotated[str, Meta(description="Serial number (MxId) of the board; empty: the only one.")] = ""
    socket: Socket = "CAM_B"
    width: Annotated[int, Meta(ge=64, le=8192)] = 1280
    height: Annotated[int, Meta(ge=64, le=8192)] = 800
    trigger: Annotated[
        Literal["snapshot", "continuous"],
        Meta(description="snapshot: a frame an edge, at any time; continuous: edges must come at ``fps``."),
    ] = "snapshot"
    fps: Annotated[float, Meta(ge=0.1, le=120.0, description="Rate of the trigger, for continuous.")] = 10.0
    exposure_us: Annotated[
        int, Meta(ge=10, le=100_000, description="Handheld: 5 ms at most, or turning blurs the picture.")
    ] = 3000
    iso: Annotated[int, Meta(ge=100, le=1600)] = 400
    jpeg_quality: Annotated[int, Meta(ge=1, le=100)] = 92
    trigger_delay_us: Annotated[
        float, Meta(ge=0.0, le=10_000.0, description="From the edge to the start of exposure (calibrated).")
    ] = 0.0
    tie_groups: Annotated[
        bool | None, Meta(description="Join the board's two FSIN groups; none: as its revision needs.")
    ] = None


class FilesSettings(Struct, frozen=True, forbid_unknown_fields=True, tag="files", tag_field="kind"):
    """Images of a folder (in order of name) or frames of a video, at a steady rate: for work on the bench."""

    path: str
    name: str = "cam_0"
    rate_hz: Annotated[float, Meta(ge=0.1, le=120.0)] = 10.0
    exposure_us: Annotated[int, Meta(ge=0, le=1_000_000)] = 0
    repeat: Annotated[bool, Meta(description="Begin again after the last.")] = True
    jpeg_quality: Annotated[int, Meta(ge=1, le=100)] = 92


class SharedSettings(Struct, frozen=True, forbid_unknown_fields=True, tag="shared", tag_field="kind"):
    """A camera of another process of this computer, such as the virtual one: a ring in a file of shared memory."""

    path: str
    name: str = "cam_0"
    most_bytes: Annotated[
        int, Meta(description="Of one photograph; the same on both sides.", ge=1024, le=100_000_000)
    ] = 2_000_000


CameraSettings = OakSettings | FilesSettings | SharedSettings

_MOST_FILE_BYTES = 8_000_000


def most_bytes(settings: CameraSettings) -> int:
    """How large a photograph of this camera can be."""
    if isinstance(settings, OakSettings):
        return settings.width * settings.height * 3
    return _MOST_FILE_BYTES if isinstance(settings, FilesSettings) else settings.most_bytes
