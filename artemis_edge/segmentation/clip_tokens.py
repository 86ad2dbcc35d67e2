"""CLIP's byte-pair tokenizer (Radford et al. 2021), from its published vocabulary file.

The file (``bpe_simple_vocab_16e6.txt.gz``) is the user's; it is part of a registered model.
"""

from __future__ import annotations

import gzip
import html
import unicodedata
from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from artemis_edge.errors import InputError
from artemis_edge.frames import I64

CONTEXT = 77
_BYTES = 256
_SPECIAL = 2  # start and end of text
_TOKENS = 49408
_MERGES = _TOKENS - 2 * _BYTES - _SPECIAL
_SUFFIXES = ("'s", "'t", "'re", "'ve", "'m", "'ll", "'d")
_END_OF_WORD = "</w>"

Pair = tuple[str, str]


class Tokenizer:
    """Texts to the 77 ids that CLIP's text encoder takes."""

    def __init__(self, vocabulary: Path) -> None:
        merges = _read_merges(vocabulary)
        self._alphabet = _byte_alphabet()
        letters = list(self._alphabet.values())
        tokens = [*letters, *(letter + _END_OF_WORD for letter in letters)]
        tokens += [first + second for first, second in merges]
        self._id = {token: k for k, token in enumerate(tokens)}
        self._start, self._end = _TOKENS - 2, _TOKENS - 1
        self._rank = {pair: k for k, pair in enumerate(merges)}

    def encode(self, texts: Iterable[str]) -> I64:
        """int64 (n, 77): start, ids, end, then zeros; longer texts are cut."""
        rows = []
        for text in texts:
            ids = [part for word in words_of(text) for part in self._ids(word)][: CONTEXT - _SPECIAL]
            row = [self._start, *ids, self._end]
            rows.append(row + [0] * (CONTEXT - len(row)))
        return np.array(rows, np.int64).reshape(-1, CONTEXT)

    def _ids(self, word: str) -> list[int]:
        letters = [self._alphabet[byte] for byte in word.encode("utf-8")]
        letters[-1] += _END_OF_WORD
        return [self._id[token] for token in self._merged(letters)]

    def _merged(self, tokens: list[str]) -> list[str]:
        """The pair that was learnt first is merged, until no learnt pair is left."""
        while len(tokens) > 1:
            best = min(pairwise(tokens), key=lambda pair: self._rank.get(pair, _MERGES))
            if best not in self._rank:
                break
            tokens = _merge(tokens, best)
        return tokens


def _merge(tokens: list[str], pair: Pair) -> list[str]:
    out: list[str] = []
    k = 0
    while k < len(tokens):
        step = 2 if tuple(tokens[k : k + 2]) == pair else 1
        out.append("".join(tokens[k : k + step]))
        k += step
    return out


def _read_merges(path: Path) -> list[Pair]:
    """Pairs in the order they were learnt: after a headline, two tokens a line."""
    try:
        content = path.read_bytes()
        if content[:2] == b"\x1f\x8b":
            content = gzip.decompress(content)
        lines = content.decode("utf-8").split("\n")[1 : _MERGES + 1]
    except (OSError, EOFError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the vocabulary {path.name} ({error}); download it again") from None
    pairs = [tuple(line.split()) for line in lines]
    if len(pairs) != _MERGES or any(len(pair) != 2 for pair in pairs):
        raise InputError(
            f"{path.name} is not CLIP's vocabulary of {_MERGES} pairs; give bpe_simple_vocab_16e6.txt.gz"
        )
    return [(pair[0], pair[1]) for pair in pairs]


def _byte_alphabet() -> dict[int, str]:
    """A printable character for every byte: its own where it has one, else one from U+0100 on."""
    printable = [
        *range(ord("!"), ord("~") + 1),
        *range(ord("¡"), ord("¬") + 1),
        *range(ord("®"), ord("ÿ") + 1),
    ]
    alphabet = {byte: chr(byte) for byte in printable}
    hidden = [byte for byte in range(_BYTES) if byte not in alphabet]
    alphabet.update({byte: chr(_BYTES + k) for k, byte in enumerate(hidden)})
    return alphabet


def words_of(text: str) -> Iterator[str]:
    """The pieces that CLIP merges within: runs of letters, single digits, runs of other signs, English suffixes."""
    cleaned = " ".join(html.unescape(html.unescape(text)).split()).lower()
    k = 0
    while k < len(cleaned):
        size = _piece(cleaned, k)
        if not cleaned[k].isspace():
            yield cleaned[k : k + size]
        k += size


def _piece(text: str, start: int) -> int:
    """Length of the piece that begins there."""
    for suffix in _SUFFIXES:
        if text.startswith(suffix, start):
            return len(suffix)
    kind = _kind(text[start])
    if kind in "N ":
        return 1
    stop = start + 1
    while stop < len(text) and _kind(text[stop]) == kind:
        stop += 1
    return stop - start


def _kind(character: str) -> str:
    """L letter, N number, a space, or * anything else."""
    if character.isspace():
        return " "
    major = unicodedata.category(character)[0]
    return major if major in "LN" else "*"
