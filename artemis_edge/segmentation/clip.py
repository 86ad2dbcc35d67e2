"""Texts and regions of an image as vectors that can be compared: CLIP's encoders (Radford et al. 2021)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.frames import F32, U8
from artemis_edge.segmentation.clip_tokens import CONTEXT, Tokenizer
from artemis_edge.segmentation.network import Array, Network
from artemis_edge.segmentation.words import canonical

# Statistics of the photographs CLIP was trained with, RGB on 0..1, as published with it.
_MEAN = np.array([0.48145466, 0.4578275, 0.40821073], np.float32)
_STD = np.array([0.26862954, 0.26130258, 0.27577711], np.float32)
_WHITE = 255
_VOWELS = "aeiou"


def phrase(word: str) -> str:
    """The text whose vector stands for a class."""
    return f"a photo of {'an' if word[:1] in _VOWELS else 'a'} {word}"


def unit(vectors: Array) -> F32:
    """Rows scaled to length 1."""
    rows = np.asarray(vectors, np.float32)
    return np.asarray(rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12), np.float32)


class TextFeatures(Protocol):
    """Gives classes their vectors."""

    def features(self, words: Sequence[str]) -> F32:
        """Unit vectors float32 (n, d); raises KeyError for a word that has none."""
        ...

    def knows(self, word: str) -> bool:
        """Whether the word has a vector."""
        ...


class TextEncoder:
    """CLIP's text encoder: ``ids`` int [n or 1, 77] to vectors [n, d]."""

    def __init__(self, network: Network, tokenizer: Tokenizer) -> None:
        shape = next(iter(network.inputs.values()))
        if len(network.inputs) != 1 or len(shape) != 2 or shape[1] not in (CONTEXT, None):
            raise InputError(
                f"{network.file} is not a text encoder: its input is not [n, {CONTEXT}] token ids"
            )
        self._network = network
        self._tokenizer = tokenizer
        self._one_by_one = shape[0] is not None
        self._known: dict[str, F32] = {}

    def knows(self, word: str) -> bool:
        """Every text has a vector."""
        return bool(word)

    def features(self, words: Sequence[str]) -> F32:
        """Unit vectors; each word is encoded once."""
        new = [word for word in dict.fromkeys(words) if word not in self._known]
        if new:
            ids = self._tokenizer.encode(phrase(word) for word in new)
            self._known.update(zip(new, unit(in_batches(self._network, ids, self._one_by_one)), strict=True))
        return np.stack([self._known[word] for word in words])


class EmbeddingTable:
    """Vectors made beforehand: an .npy file (n, d) and the names of its rows."""

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        try:
            table = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise InputError(f"{path.name} is not a table of vectors ({error}); give an .npy file") from None
        if table.ndim != 2 or len(table) < len(names) or not names:
            raise InputError(
                f"{path.name} has shape {table.shape}; the {len(names)} classes of the model need a row each"
            )
        self._vectors = unit(table)
        self._row = {canonical(name): k for k, name in reversed(list(enumerate(names)))}

    def knows(self, word: str) -> bool:
        """Whether a row has that name."""
        return word in self._row

    def features(self, words: Sequence[str]) -> F32:
        """Unit vectors float32 (n, d)."""
        return self._vectors[[self._row[word] for word in words]]


class ImageEncoder:
    """CLIP's image encoder: [n or 1, 3, s, s] to vectors [n, d]."""

    def __init__(self, network: Network, size_if_open: int = 224) -> None:
        shape = next(iter(network.inputs.values()))
        if len(network.inputs) != 1 or len(shape) != 4 or shape[1] not in (3, None):
            raise InputError(f"{network.file} is not an image encoder: its input is not [n, 3, s, s]")
        self._network = network
        self._size = shape[2] or size_if_open
        self._one_by_one = shape[0] is not None

    def features(self, crops: Sequence[U8]) -> F32:
        """Unit vectors float32 (n, d) of square images uint8 (s, s, 3) of any size."""
        size = (self._size, self._size)
        scaled = [cv2.resize(crop, size, interpolation=cv2.INTER_AREA) for crop in crops]
        batch = (np.stack(scaled).astype(np.float32) / _WHITE - _MEAN) / _STD
        return unit(in_batches(self._network, batch.transpose(0, 3, 1, 2), self._one_by_one))


def in_batches(network: Network, rows: Array, one_by_one: bool) -> Array:
    """The first output of a network for all rows: at once, or singly where its batch is fixed to one."""
    parts = [rows[k : k + 1] for k in range(len(rows))] if one_by_one else [rows]
    return np.concatenate([next(iter(network.run(part).values())) for part in parts])


def region(image: U8, mask: F32, box: tuple[int, int, int, int]) -> U8:
    """What is inside a mask, on white, centred in a square: uint8 (s, s, 3).

    ``mask`` (h, w) 0..1 covers ``box`` x0, y0, x1, y1 of the image.
    """
    x0, y0, x1, y1 = box
    cut = image[y0:y1, x0:x1].astype(np.float32)
    shown = (cut - _WHITE) * mask[:, :, None] + _WHITE
    side = max(x1 - x0, y1 - y0)
    square = np.full((side, side, 3), _WHITE, np.uint8)
    top, left = (side - (y1 - y0)) // 2, (side - (x1 - x0)) // 2
    square[top : top + y1 - y0, left : left + x1 - x0] = shown.astype(np.uint8)
    return square
