"""Muon: gradient steps whose matrices are made orthogonal (Jordan et al., 2024), for a network's inner weights.

All directions that a matrix of weights acts in are learnt at one speed. Steps are as long as
Adam's, element by element (Liu et al., "Muon is scalable for LLM training", 2025).
"""

from __future__ import annotations

import torch
from torch import Tensor

_COEFFICIENTS = (3.4445, -4.7750, 2.0315)  # of Jordan's quintic, which brings singular values to about 1
_ITERATIONS = 5
_MOMENTUM = 0.95
_ADAM_LENGTH = 0.2  # root mean square of an element of Adam's steps, of its rate


def orthogonal(matrices: Tensor) -> Tensor:
    """(n, rows, columns): singular values near 1, singular vectors kept (Newton and Schulz's iteration)."""
    a, b, c = _COEFFICIENTS
    x = matrices / (matrices.norm(dim=(1, 2), keepdim=True) + 1e-7)
    tall = x.shape[1] > x.shape[2]
    x = x.mT if tall else x
    for _ in range(_ITERATIONS):
        square = x @ x.mT
        x = a * x + (b * square + c * square @ square) @ x
    return x.mT if tall else x


class Muon(torch.optim.Optimizer):
    """Parameters of two or more axes, each taken for a matrix of the first against all others."""

    def __init__(self, params: list[Tensor], lr: float, weight_decay: float) -> None:
        super().__init__(params, {"lr": lr, "weight_decay": weight_decay})

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """One step; matrices of one shape together."""
        for group in self.param_groups:
            by_shape: dict[tuple[int, int], list[Tensor]] = {}
            for p in group["params"]:
                by_shape.setdefault((p.shape[0], p.numel() // p.shape[0]), []).append(p)
            for shape, alike in by_shape.items():
                steps = orthogonal(torch.stack([self._smoothed(p).reshape(shape) for p in alike]))
                length = group["lr"] * _ADAM_LENGTH * max(shape) ** 0.5
                for p, step in zip(alike, steps, strict=True):
                    p.mul_(1 - group["lr"] * group["weight_decay"])
                    p.sub_(step.reshape(p.shape), alpha=length)

    def _smoothed(self, p: Tensor) -> Tensor:
        """Nesterov's momentum."""
        assert p.grad is not None
        mean = self.state[p].setdefault("mean", torch.zeros_like(p))
        mean.lerp_(p.grad, 1 - _MOMENTUM)
        return p.grad.lerp(mean, _MOMENTUM)
