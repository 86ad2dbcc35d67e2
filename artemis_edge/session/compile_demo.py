"""The kernels of the demo compiled while its walk is recorded: a newcomer waits for the longer of the two."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from artemis_edge.compile_ahead import begin
from artemis_edge.datasets import open_input
from artemis_edge.progress import say
from artemis_edge.runtime import Request
from artemis_edge.session import made_up_room


@contextmanager
def compiling(request: Request) -> Iterator[None]:
    """Compile for ``request`` beside what is done inside, on a made-up room that has what the walk has; once."""
    with tempfile.TemporaryDirectory(prefix="artemis-demo-") as name:
        room = Path(name)
        made_up_room.record(room)
        source = open_input(room)
        compilation = begin(replace(request, input=room), source, range(len(source)))
        yield
        if compilation.working():
            say("compiling for this machine (once; a minute or two)")
        compilation.wait()
