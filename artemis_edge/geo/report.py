"""The georeference in the report of a map: a part of ``report.json`` and a section of ``report.html``."""

from __future__ import annotations

import json
import re
from html import escape
from pathlib import Path
from typing import Any

from artemis_edge.errors import InputError
from artemis_edge.export.atomic import write_bytes
from artemis_edge.geo.place import Georeference, to_json
from artemis_edge.json_file import read_json

_BEGIN, _END = "<!-- georeference -->", "<!-- end of georeference -->"


def add_to_report(folder: Path, made: Georeference) -> None:
    """Into both files of an output directory, in the place of an earlier one; InputError if they are no reports."""
    report, page = read_report(folder)
    report["georeference"] = to_json(made)
    end = page.rindex("</body>")
    write_bytes(folder / "report.json", (json.dumps(report, indent=2, ensure_ascii=False) + "\n").encode())
    if _BEGIN in page:
        page = re.sub(f"{_BEGIN}.*{_END}", lambda _: section(made), page, flags=re.DOTALL)
    else:
        page = f"{page[:end]}{section(made)}\n{page[end:]}"
    write_bytes(folder / "report.html", page.encode())


def read_report(folder: Path) -> tuple[dict[str, Any], str]:
    """Values and page of an output directory's report; InputError if there is none to be added to."""
    try:
        report = read_json(folder / "report.json")
        page = (folder / "report.html").read_text("utf-8")
    except (OSError, ValueError):
        report, page = None, ""
    if not isinstance(report, dict) or "</body>" not in page:
        raise InputError(f"{folder} has no report of this version; map the recording again")
    return report, page


def section(made: Georeference) -> str:
    """A heading, how well it fits, and a row for each control point."""
    rows = "".join(
        f"<tr><td>{escape(p.name)}</td><td>{p.given[0]:.3f}, {p.given[1]:.3f}, {p.given[2]:.3f}</td>"
        + "".join(f"<td>{value:+.3f}</td>" for value in p.off)
        + f"<td>{p.distance_m:.3f}</td><td>{'' if p.left_out_m is None else f'{p.left_out_m:.3f}'}</td></tr>"
        for p in made.points
    )
    titles = ("point", "east, north, up", "off east", "north", "up", "distance", "when not used")
    head = "".join(f"<th>{title}</th>" for title in titles)
    return (
        f'{_BEGIN}<h2>Control points</h2><p class="sub">{escape(sentence(made))}</p>'
        f'<div class="card"><table><tr>{head}</tr>{rows}</table></div>{_END}'
    )


def sentence(made: Georeference) -> str:
    """In one sentence, metres."""
    apart = "" if made.left_out_rms_m is None else f" ({made.left_out_rms_m:.3f} m where each is left out)"
    return (
        f"EPSG:{made.epsg} ({made.name}): {len(made.points)} control points fit within {made.rms_m:.3f} m rms{apart}; "
        f"distances differ by {abs(made.scale - 1.0):.2%}"
    )
