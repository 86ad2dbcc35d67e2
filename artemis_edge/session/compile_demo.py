"""The kernels of the demo compiled while its walk is recorded: a newcomer waits for the longer of the two."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from artemis_edge._jit import cache_dir
from artemis_edge.compile_ahead import begin, leave
from artemis_edge.datasets import open_input
from artemis_edge.progress import say
from artemis_edge.runtime import Request
from artemis_edge.session.simulate import simulate

_SECONDS = 0.3
_WITHOUT_TRUTH = {"reference": "off", "mesh": "off", "point_truth": "off"}


@contextmanager
def compiling(request: Request, world: str, seed: int, settings: Mapping[str, str]) -> Iterator[None]:
    """Compile for ``request`` beside what is done inside, from the first moments of the same walk; once."""
    marker = cache_dir() / f"compiled-demo-{'with' if request.queries else 'without'}-questions"
    if marker.exists():
        yield
        return
    with tempfile.TemporaryDirectory(prefix="artemis-demo-") as name:
        start = Path(name)
        simulate(world, seed, _SECONDS, "avia", start, {**settings, **_WITHOUT_TRUTH})
        source = open_input(start)
        compilation = begin(replace(request, input=start), source, range(len(source)))
        yield
        if compilation.working():
            say("compiling for this machine (once; a minute or two)")
        compilation.wait()
    leave(marker)
