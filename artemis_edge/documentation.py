"""The table of all settings in ``docs/tuning.md``, made from ``config.py`` so that the two cannot differ.

python -m artemis_edge.documentation docs/tuning.md
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import msgspec
from msgspec.inspect import Field, FloatType, IntType, StructType, type_info

from artemis_edge.config import Config

_BEGIN, _END = "<!-- settings: generated -->", "<!-- end of settings -->"


def settings_table() -> str:
    """Markdown: a heading and a table for each section, a row for each field."""
    root = type_info(Config)
    assert isinstance(root, StructType)
    return "\n".join([_BEGIN, *(_section(field) for field in root.fields), _END])


def update(path: Path) -> None:
    """Replace the part of a file that stands between the two marks."""
    text = path.read_text()
    before, rest = text.split(_BEGIN)
    path.write_text(before + settings_table() + rest.split(_END)[1])


def _section(section: Field) -> str:
    struct: Any = section.type
    summary = " ".join((struct.cls.__doc__ or "").split())
    head = [
        f"\n### `[{section.name}]`\n\n{summary}\n",
        "| field | default | range | meaning |",
        "|---|---|---|---|",
    ]
    return "\n".join(head + [_row(field) for field in struct.fields]) + "\n"


def _row(field: Field) -> str:
    description, kind = "", field.type
    if isinstance(kind, msgspec.inspect.Metadata):
        description = str((kind.extra_json_schema or {}).get("description", ""))
        kind = kind.type
    return f"| `{field.name}` | {_value(field.default)} | {_range(kind)} | {description} |"


def _value(value: Any) -> str:
    if isinstance(value, str | tuple):
        return "empty" if not value else f"`{value}`"
    return f"{str(value).lower() if isinstance(value, bool) else value}"


def _range(kind: Any) -> str:
    if not isinstance(kind, FloatType | IntType):
        return ""
    bounds = [(">=", kind.ge), (">", kind.gt), ("<=", kind.le), ("<", kind.lt)]
    return ", ".join(f"{sign} {_bound(bound)}" for sign, bound in bounds if bound is not None)


def _bound(bound: float) -> str:
    return f"{bound:.0f}" if abs(bound) >= 1e5 else f"{bound:g}"


if __name__ == "__main__":
    update(Path(sys.argv[1]))
