"""Lower-envelope lines: exactness, a slow twin, wraps of nothing, degenerate input."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from artemis_edge.clock_model import AffineClock, EnvelopeFit, lower_line


def naive_line(x: list[int], y: list[int]) -> tuple[float, float]:
    """Of all lines through two points with none below, the highest at mid-span: (slope - 1, value there)."""
    best = (0.0, float("-inf"))
    middle = (x[0] + x[-1]) / 2
    for a, b in combinations(range(len(x)), 2):
        if x[a] == x[b]:
            continue
        slope = (y[b] - y[a] - (x[b] - x[a])) / (x[b] - x[a])
        at = [y[a] - x[a] + slope * (value - x[a]) for value in x]
        if all(q - p - line > -1e-3 for p, q, line in zip(x, y, at, strict=True)):
            value = y[a] - x[a] + slope * (middle - x[a])
            best = max(best, (slope, value), key=lambda candidate: candidate[1])
    return best


@given(st.lists(st.tuples(st.integers(0, 1000), st.integers(0, 2_000_000)), min_size=2, max_size=12))
def test_line_is_the_highest_below_all_points(parts: list[tuple[int, int]]) -> None:
    x = sorted({a * 1_000_000 for a, _ in parts})
    y = [a + 5_000 + delay for a, (_, delay) in zip(x, parts, strict=False)]
    if len(x) < 2:
        return
    model = lower_line(x, y, max_skew=1e9)
    _, value = naive_line(x, y)
    assert all(model.to_y(a) <= b + 1 for a, b in zip(x, y, strict=True))
    middle = (x[0] + x[-1]) // 2
    assert model.to_y(middle) - middle == pytest.approx(value, abs=2)


@pytest.mark.parametrize("skew_ppm", [-100.0, 0.0, 100.0])
@pytest.mark.parametrize("law", ["uniform", "exponential"])
def test_skew_and_offset_are_found_below_the_jitter(skew_ppm: float, law: str) -> None:
    rng = np.random.default_rng(3)
    truth = AffineClock(0, 10**15, skew_ppm * 1e-6)
    fit = EnvelopeFit()
    x = 0
    for x in range(0, 60 * 10**9, 50_000_000):
        delay = rng.uniform(0, 2e6) if law == "uniform" else rng.exponential(2e6)
        fit.add(x, truth.to_y(x) + round(delay))
    model = fit.model()
    assert model is not None
    assert abs(model.to_y(x) - truth.to_y(x)) < 150_000
    assert abs(model.skew_ppm - skew_ppm) < 3.0
    quality = fit.quality()
    assert (
        quality.events == 1200 and quality.span_s == pytest.approx(60, abs=1) and quality.doubt_ns < 1_000_000
    )
    known = fit.model(skew_ppm * 1e-6)
    assert known is not None and 0 <= known.to_y(x) - truth.to_y(x) < 20_000


@given(
    st.integers(-(10**18), 10**18),
    st.integers(-(10**18), 10**18),
    st.floats(-2e-4, 2e-4),
    st.integers(-(10**14), 10**14),
)
def test_there_and_back(x0: int, y0: int, skew: float, ahead: int) -> None:
    clock = AffineClock(x0, y0, skew)
    assert abs(clock.to_x(clock.to_y(x0 + ahead)) - (x0 + ahead)) <= 1


def test_only_the_window_counts() -> None:
    """A step of the host's clock is forgotten after the window has passed."""
    fit = EnvelopeFit(window_s=10.0, bin_s=0.5)
    for k in range(600):
        fit.add(k * 100_000_000, k * 100_000_000 + (0 if k < 100 else 5_000_000))
    model = fit.model()
    assert model is not None and model.to_y(59_900_000_000) == 59_905_000_000
    fit.add(0, 0)
    assert fit.ignored == 1
    assert fit.quality().span_s <= 10.0


def test_late_news_of_an_old_event_counts() -> None:
    fit = EnvelopeFit()
    for k in (0, 1, 2, 4, 5):
        fit.add(k * 10**9, k * 10**9 + 1_000_000)
    fit.add(3 * 10**9, 3 * 10**9 + 200_000)
    model = fit.model()
    assert model is not None and model.to_y(3 * 10**9) == 3 * 10**9 + 200_000


def test_skew_is_bounded() -> None:
    fit = EnvelopeFit(max_skew_ppm=200.0)
    fit.add(0, 2_000_000)
    fit.add(10**9, 10**9)
    model = fit.model()
    assert model is not None and model.skew_ppm == pytest.approx(-200.0)
    assert model.to_y(10**9) == 10**9


def test_without_events_there_is_no_line() -> None:
    fit = EnvelopeFit()
    assert fit.model() is None and fit.quality().events == 0 and fit.span_s == 0.0
    fit.add(5, 7)
    model = fit.model()
    assert model is not None and model.to_y(5) == 7
    fit.restart()
    assert fit.model() is None
