"""The picture in pixels where the terminal can show them: sixel or kitty's protocol, by textual-image (an extra)."""

from __future__ import annotations

import os
import termios
from typing import TYPE_CHECKING, NamedTuple

from textual.app import ComposeResult

from artemis_edge.config import Config
from artemis_edge.frames import U8
from artemis_edge.tui.widgets import MeshPicture

if TYPE_CHECKING:
    from textual_image.widget import SixelImage, TGPImage

VARIABLE = "ARTEMIS_GRAPHICS"
_EACH = 3  # pixels of the terminal across one of the picture: vertices are no denser


class Graphics(NamedTuple):
    """How this terminal shows pixels, and how many (width, height) a character has."""

    image: type[SixelImage | TGPImage]
    cell: tuple[int, int]


def find_graphics() -> Graphics | None:
    """What the terminal says that it can; None: half blocks. To be asked before the application reads its keys.

    ``ARTEMIS_GRAPHICS`` may say ``off``, or ``on``: also over SSH, where some hundred kilobytes a picture may be too
    much and an answer too late.
    """
    wanted = os.environ.get(VARIABLE, "")
    remote = any(os.environ.get(name) for name in ("SSH_CONNECTION", "SSH_TTY"))
    if wanted == "off" or (remote and wanted != "on"):
        return None
    try:
        from textual_image import renderable  # asks as it is imported, for at most some tenths of a second
        from textual_image._terminal import get_cell_size
        from textual_image.widget import SixelImage, TGPImage
    except (ImportError, OSError, ValueError, termios.error):
        return None
    if renderable.Image is renderable.SixelImage:
        return Graphics(SixelImage, get_cell_size())
    if renderable.Image is renderable.TGPImage:
        return Graphics(TGPImage, get_cell_size())
    return None


class PixelPicture(MeshPicture):
    """The picture below its caption; a message instead of it as with half blocks."""

    spacing_m = 0.25 * Config().voxel_map.voxel_m
    DEFAULT_CSS = "PixelPicture > * { width: 1fr; height: 1fr; margin: 1 0 0 0; }"

    def __init__(self, graphics: Graphics, id: str | None = None) -> None:
        super().__init__(id=id)
        self._cell = graphics.cell
        self._image = graphics.image()

    def compose(self) -> ComposeResult:
        """The pixels."""
        yield self._image

    @property
    def pixels(self) -> tuple[int, int]:
        """Width and height that fill the widget."""
        width, height = self.size.width * self._cell[0], (self.size.height - 1) * self._cell[1]
        return max(width // _EACH, 1), max(height // _EACH, 1)

    def show(self, image: U8) -> None:
        """Take over a picture uint8 (h, w, 3)."""
        from PIL import Image

        self.refresh()  # caption and message
        self._image.display = not self.message
        if not self.message:
            whole = (image.shape[1] * _EACH, image.shape[0] * _EACH)
            self._image.image = Image.fromarray(image).resize(whole, Image.Resampling.NEAREST)
