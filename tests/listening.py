"""Who can be connected to from outside: TCP sockets of a process and of those that it started."""

from __future__ import annotations

import re
from pathlib import Path

_LISTEN = "0A"


def listening(pid: int) -> list[str]:
    """Local addresses (hexadecimal, as in /proc/net/tcp) at which the processes listen."""
    own = {inode for each in _family(pid) for inode in _sockets(each)}
    found = []
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == _LISTEN and words[9] in own:
                found.append(words[1])
    return found


def _family(pid: int) -> list[int]:
    """The process and all below it."""
    parents: dict[int, int] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            text = stat.read_text()
        except OSError:
            continue  # it has ended meanwhile
        parents[int(text.split()[0])] = int(text[text.rindex(")") + 2 :].split()[1])
    family = [pid]
    for member in family:
        family += [child for child, parent in parents.items() if parent == member]
    return family


def _sockets(pid: int) -> list[str]:
    found = []
    for descriptor in Path(f"/proc/{pid}/fd").glob("*"):
        try:
            match = re.fullmatch(r"socket:\[(\d+)\]", str(descriptor.readlink()))
        except OSError:
            continue
        found += [match[1]] if match else []
    return found
