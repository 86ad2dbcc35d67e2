"""What somebody may have meant by a word that no model knows: a slip of the keyboard, or another language.

A hint is a sentence for people. It is never acted upon: what is not understood is not looked for.
"""

from __future__ import annotations

from collections.abc import Collection
from difflib import get_close_matches

from artemis_edge.segmentation.words import Vocabulary, vocabulary

_ALIKE = 0.8  # share of letters in common, in order
_ENGLISH = "questions are understood in English"


def hint(noun: str, classes: Collection[str]) -> str:
    """ "did you mean 'person'?" for a noun that a model of these classes (canonical) does not know; "" for none."""
    words = vocabulary()
    if not classes or words.find(noun) is not None:
        return ""
    spelled = _slip(noun, words, classes)
    if spelled:
        return f"did you mean '{spelled}'?"
    parts = noun.split(" ")
    meant = {part: words.foreign[part] for part in parts if part in words.foreign}
    if meant:
        english = (meant.get(part) or words.find(part) for part in parts)
        named = [f"'{name}'" for name in dict.fromkeys(english) if name]
        return f"{_ENGLISH}: try {' or '.join(named)}"
    return "" if noun.isascii() else _ENGLISH


def _slip(noun: str, words: Vocabulary, classes: Collection[str]) -> str:
    """The known spelling that the noun, or its last word, is nearest to; "" where none is near."""
    known = [spelling for spelling, name in words.canonical.items() if _answered(name, words, classes)]
    for text in dict.fromkeys((noun, noun.rsplit(" ", 1)[-1])):
        swapped = (s for s in known if s[0] == text[0] and sorted(s) == sorted(text))
        found = next(swapped, None) or next(iter(get_close_matches(text, known, 1, _ALIKE)), "")
        if found and words.find(text) is None:
            return found
    return ""


def _answered(name: str, words: Vocabulary, classes: Collection[str]) -> bool:
    """Whether a model of these classes has an answer to a canonical name."""
    near = (name, *words.narrower(name), *words.broader(name))
    return any(word in classes for word in near)
