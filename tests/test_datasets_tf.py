"""The transform tree."""

from __future__ import annotations

import numpy as np

from artemis_edge.datasets.tf_tree import TransformTree
from artemis_edge.frames import F64
from artemis_edge.trajectory import inverse, matrix_from_quaternion, quaternion_from_matrix

NOW = np.array([0])
SECOND = 1_000_000_000


def _random(seed: int) -> F64:
    rng = np.random.default_rng(seed)
    return matrix_from_quaternion(rng.normal(size=3), rng.normal(size=4))


def _add(
    tree: TransformTree, parent: str, child: str, T: F64, stamp_ns: int = 0, moving: bool = False
) -> None:
    tree.add(parent, child, stamp_ns, T[:3, 3], quaternion_from_matrix(T), moving=moving)


def _moving_tree() -> tuple[TransformTree, list[F64]]:
    """map -> odom (moving, 1 Hz) -> base (moving, 10 Hz) -> lidar, cam (fixed)."""
    tree, fixed = TransformTree(), [_random(1), _random(2)]
    for k in range(11):
        T = np.eye(4)
        T[:3, 3] = k, 0, 0
        _add(tree, "odom", "base", T, k * SECOND // 10, moving=True)
    for k in range(2):
        T = np.eye(4)
        T[:3, 3] = 0, k, 0
        _add(tree, "/map", "/odom", T, k * SECOND, moving=True)
    _add(tree, "base", "lidar", fixed[0])
    _add(tree, "base", "cam", fixed[1])
    return tree, fixed


def test_lookup_down_up_and_across() -> None:
    tree, (T_base_lidar, T_base_cam) = _moving_tree()
    stamps = np.array([0, SECOND // 4, SECOND])
    T, known = tree.lookup("map", "lidar", stamps)
    assert known.all()
    for at, x, y in ((0, 0, 0), (1, 2.5, 0.25), (2, 10, 1)):
        T_map_base = np.eye(4)
        T_map_base[:2, 3] = x, y
        np.testing.assert_allclose(T[at], T_map_base @ T_base_lidar, atol=1e-12)
    back, _ = tree.lookup("lidar", "map", stamps)
    np.testing.assert_allclose(back, inverse(T), atol=1e-12)
    across, known = tree.lookup("cam", "lidar", np.array([-99 * SECOND]))
    assert known.all()  # nothing between them moves
    np.testing.assert_allclose(across[0], inverse(T_base_cam) @ T_base_lidar, atol=1e-12)


def test_what_is_not_covered_is_not_known() -> None:
    tree, _ = _moving_tree()
    stamps = np.array([-SECOND, -1_000_001, -1_000_000, 0, SECOND, SECOND + 1_000_001])
    assert tree.lookup("map", "lidar", stamps)[1].tolist() == [False, False, True, True, True, False]
    assert not tree.lookup("map", "elsewhere", NOW)[1].any()


def test_paths() -> None:
    tree, _ = _moving_tree()
    assert tree.path_up("lidar") == ["lidar", "base", "odom", "map"]
    assert tree.path_up("unknown") == ["unknown"]
    assert tree.moves("lidar") and tree.moves("base") and not tree.moves("map") and not tree.moves("unknown")
    assert tree.connected("cam", "lidar") and not tree.connected("cam", "unknown")


def test_fixed_mounting_published_again_and_again_does_not_move() -> None:
    tree = TransformTree()
    for k in range(5):
        _add(tree, "base", "lidar", _random(1), 100 + k, moving=True)
    assert not tree.moves("lidar")
    assert tree.lookup("base", "lidar", NOW)[1].all()


def test_a_single_moving_sample_holds_only_at_its_stamp() -> None:
    tree = TransformTree()
    _add(tree, "map", "lidar", _random(1), SECOND, moving=True)
    assert tree.moves("lidar")
    assert tree.lookup("map", "lidar", np.array([0, SECOND]))[1].tolist() == [False, True]


def test_unordered_and_repeated_samples() -> None:
    tree = TransformTree()
    for x, stamp in ((2.0, 2), (0.0, 0), (9.0, 1), (1.0, 1)):
        T = np.eye(4)
        T[0, 3] = x
        _add(tree, "map", "lidar", T, stamp * SECOND, moving=True)
    T, _ = tree.lookup("map", "lidar", np.array([0, SECOND // 2, SECOND, 2 * SECOND]))
    assert T[:, 0, 3].tolist() == [0.0, 0.5, 1.0, 2.0]  # the last of a stamp counts


def test_transforms_that_are_none() -> None:
    tree, eye = TransformTree(), np.array([0.0, 0, 0, 1])
    tree.add("a", "b", 0, np.zeros(3), np.zeros(4), moving=False)
    tree.add("a", "b", 0, np.array([np.nan, 0, 0]), eye, moving=False)
    tree.add("a", "/a", 0, np.zeros(3), eye, moving=False)
    assert tree.broken == 3 and tree.path_up("b") == ["b"]


def test_a_loop_ends() -> None:
    tree = TransformTree()
    _add(tree, "a", "b", _random(1))
    _add(tree, "b", "a", _random(2))
    assert tree.path_up("a") == ["a", "b"]
    tree.lookup("a", "b", NOW)


def test_of_two_parents_the_busier_counts() -> None:
    tree = TransformTree()
    _add(tree, "wrong", "lidar", _random(1))
    for k in range(3):
        _add(tree, "map", "lidar", _random(k), k, moving=True)
    assert tree.path_up("lidar") == ["lidar", "map"]
