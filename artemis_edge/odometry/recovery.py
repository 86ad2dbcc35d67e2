"""Where the state is unsure, after a hole of the IMU before a blank wall: look for the place all over the prior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from artemis_edge.odometry.plane_update import Explained, PlaneMeasurement
from artemis_edge.odometry.state import ROTATION, VELOCITY, State, iterated_update

_ITERATIONS = 8
_CONVERGED = 2e-4  # m and rad
_DRAWS, _REFINED = 200, 5  # states tried, and registered
_BASIN = 0.4  # of the deviation: what the nearest of 200 draws in six dimensions is away
_OPENED_RAD = 0.1


class Registered(NamedTuple):
    """A state after the LiDAR update, and how the scan fits there."""

    state: State
    explained: Explained


def registered(prior: State, measured: PlaneMeasurement, start: State | None = None) -> Registered:
    """The update of a prior, begun at a state (the prior itself by default)."""
    state = iterated_update(prior, measured, _ITERATIONS, _CONVERGED, start)
    return Registered(state, measured.explained(state))


def searched(prior: State, measured: Callable[[float], PlaneMeasurement]) -> Registered:
    """The update that explains most of the scan of those begun at the best of many states drawn from the prior.

    ``measured`` gives the measurement that begins with a share of the misalignment that the prior leaves open.
    """
    rough = measured(_BASIN)
    guesses = drawn(prior, _DRAWS)
    order = np.argsort([-rough.score(guess) for guess in guesses], kind="stable")
    found = [registered(prior, measured(_BASIN), guesses[k]) for k in order[:_REFINED]]
    return max(found, key=lambda one: one.explained.score)


def drawn(state: State, number: int) -> list[State]:
    """States drawn from the covariance of one; always the same."""
    values, vectors = np.linalg.eigh(state.P)
    normal = np.random.default_rng(0).standard_normal((number, len(state)))
    return [state.plus(e) for e in normal * np.sqrt(np.maximum(values, 0.0)) @ vectors.T]


def opened(state: State, speed: float) -> State:
    """A state that was believed wrongly, to begin a map with: any speed (one sigma, m/s) and attitude a bit off."""
    P = state.P.copy()
    P[VELOCITY, VELOCITY] += speed**2 * np.eye(3)
    P[ROTATION, ROTATION] += _OPENED_RAD**2 * np.eye(3)
    return replace(state, P=P)
