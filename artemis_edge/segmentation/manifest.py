"""What is known of a registered network: one JSON file beside the ONNX file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta, Struct

from artemis_edge.errors import InputError
from artemis_edge.export.atomic import write_bytes

Kind = Literal["yolo-seg", "fastsam-clip", "openvocab-seg", "semantic", "attribute"]

Side = Annotated[int, Meta(ge=32, le=4096)]
Hash = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
#: A file name beside the manifest, not a path.
FileName = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]


class Part(Struct, frozen=True, forbid_unknown_fields=True):
    """A further file that the model needs: ``image`` and ``text`` encoders, ``vocabulary``, ``embeddings``."""

    file: FileName
    sha256: Hash


class Manifest(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A network, how it is fed and what it may be used for.

    ``classes`` are the names of its outputs in order (empty: any text). For ``semantic`` one of them may be
    called "background"; it and classes nobody asks for count as background.
    ``input_size`` is (height, width) of the input. Where the file leaves height and width open, images are scaled
    to fit into it and padded to the next multiple of ``stride`` only. ``fine_input_size``, the same, is what images are
    read at, too, where nobody waits for a frame and an image has so many pixels; only where the file leaves them open.
    ``mean`` and ``std`` per channel, RGB on 0..1: the network is given (rgb / 255 - mean) / std.
    ``shares`` of the classes in the pixels that the probabilities of a ``semantic`` network were calibrated on, in the
    order of ``classes`` (empty: not known).
    ``synthetic_only``: trained on virtual worlds, of no use on photographs.
    """

    name: FileName
    kind: Kind
    file: FileName
    sha256: Hash
    licence: str
    classes: tuple[str, ...] = ()
    input_size: tuple[Side, Side] = (480, 640)
    fine_input_size: tuple[Side, Side] | None = None
    stride: Annotated[int, Meta(ge=1, le=128)] = 32
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    shares: tuple[Annotated[float, Meta(ge=0.0, le=1.0)], ...] = ()
    parts: dict[str, Part] = {}
    inputs: dict[str, tuple[int, ...]] = {}
    outputs: dict[str, tuple[int, ...]] = {}
    synthetic_only: bool = False
    source: str = ""
    note: str = ""

    def __post_init__(self) -> None:
        fine, size = self.fine_input_size, self.input_size
        if fine is not None and (fine == size or fine[0] < size[0] or fine[1] < size[1]):
            raise ValueError("fine_input_size is smaller than input_size, or the same")


def read_manifest(path: Path) -> Manifest:
    """Read a manifest; raises InputError where it is none."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=Manifest)
    except OSError as error:
        raise InputError(f"cannot read the manifest {path}: {error.strerror}") from None
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path} is not a manifest of a model ({error}); remove and add the model again"
        ) from None


def write_manifest(path: Path, manifest: Manifest) -> None:
    """Write a manifest; raises RunError when the disk refuses."""
    write_bytes(path, msgspec.json.format(msgspec.json.encode(manifest), indent=1) + b"\n")
