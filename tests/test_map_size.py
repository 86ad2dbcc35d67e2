"""The size of a map along its deltas, and of what is left after all of them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from artemis_edge.frames import MeshDelta
from artemis_edge.map_size import MapSize

_BLOCK = st.tuples(st.integers(-1, 1), st.integers(-1, 1), st.just(0))
_DELTA = st.dictionaries(_BLOCK, st.tuples(st.integers(0, 5), st.integers(0, 9)), max_size=4)


def delta_of(blocks: dict[tuple[int, int, int], tuple[int, int]]) -> MeshDelta:
    counts = np.array(list(blocks.values()), np.int64).reshape(-1, 2)
    starts = np.concatenate((np.zeros((1, 2), np.int64), counts.cumsum(axis=0)))
    v, t = starts[-1]
    return MeshDelta(
        0,
        np.array(list(blocks), np.int32).reshape(-1, 3),
        starts[:, 0],
        starts[:, 1],
        np.zeros(v, np.int64),
        np.zeros((v, 3), np.float32),
        np.zeros((v, 3), np.float32),
        np.zeros((v, 3), np.uint8),
        np.zeros(v, np.uint8),
        np.zeros(v, np.float32),
        np.zeros((t, 3), np.int64),
    )


@given(st.lists(_DELTA, max_size=6))
def test_it_is_the_sum_over_the_newest_state_of_every_block(
    deltas: list[dict[tuple[int, int, int], tuple[int, int]]],
) -> None:
    size, newest = MapSize(), {}
    for blocks in deltas:
        size.add(delta_of(blocks))
        newest.update(blocks)
    assert size.vertices == sum(v for v, _ in newest.values())
    assert size.triangles == sum(t for _, t in newest.values())
