"""Trains the network on rendered views and writes its weights.

    python training/train.py --views VIEWS --check OTHER_VIEWS --out WEIGHTS.pt [--steps N] [--seed N]
        [--start WEIGHTS.pt] [--sought SHARE] [--rate RATE] [--minutes M]

One thread; equal arguments and views, equal weights on equal machines. The weights so far are written now and
then, so that a long training can be looked at. With ``--minutes`` the rate falls to 0 within that time however slow
the machine is; how many steps that gives, and so the weights, depend on the machine.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from labels import IGNORED, NETWORK_CLASSES
from muon import Muon
from network import Network
from numpy.typing import NDArray
from samples import Views, batch, whole
from torch import Tensor, nn
from torch.nn import functional

_BATCH = 6
_RATE, _DECAY = 3e-3, 0.02  # learning rate at its highest, and weight decay
_WARM_UP = 0.02  # share of the training in which the rate rises
_AVERAGED = 0.995  # the weights kept are a running mean of those learnt
_RARE = 0.3  # power of a class's share of pixels by which it weighs less
_REPORT_EVERY, _WRITE_EVERY = 50, 250


def class_weights(shares: NDArray[np.float64]) -> Tensor:
    """float32 (classes,): rare classes weigh more, 0.6 to 3; those not there nothing."""
    weight = np.clip((np.maximum(shares, 1e-9) / 0.05) ** -_RARE, 0.6, 3.0)
    return torch.from_numpy(np.where(shares > 0, weight, 0.0).astype(np.float32))


def loss_of(logits: Tensor, label: Tensor, weights: Tensor) -> Tensor:
    """Cross entropy, weighted by class; ``label`` int64 (n, h, w) of the cells of the logits."""
    return functional.cross_entropy(logits, label, weights, ignore_index=IGNORED)


def epochs(count: int, rng: np.random.Generator) -> Iterator[int]:
    """All views in random order, again and again."""
    while True:
        yield from rng.permutation(count).tolist()


@dataclass(frozen=True, slots=True)
class Plan:
    """How long and from where to learn; ``sought`` is the share of crops that look for a class.

    Learning ends after ``steps`` batches or ``minutes`` of wall time, whichever comes first; 0 is no limit of time.
    """

    steps: int
    minutes: float
    seed: int
    sought: float
    rate: float
    start: Path | None


class Clock:
    """How much of a plan is done."""

    def __init__(self, how: Plan) -> None:
        self._how, self._began, self._cpu_began = how, time.monotonic(), time.process_time()

    def done(self, step: int) -> float:
        """0 to 1, and more than 1 where the time is over."""
        spent = (time.monotonic() - self._began) / (60 * self._how.minutes) if self._how.minutes else 0.0
        return max(step / self._how.steps, spent)

    def cpu_s(self) -> float:
        """CPU time since the start."""
        return time.process_time() - self._cpu_began


def rate_share(done: float) -> float:
    """Share of the highest rate when so much of the training is done: a short rise and a straight fall to 0."""
    return min((done + 1e-3) / _WARM_UP, max(1.0 - done, 0.0))


def train(views: Views, how: Plan, out: Path) -> Network:
    """The network after learning by the plan; its weights are written to ``out``."""
    torch.manual_seed(how.seed)
    rng = np.random.default_rng([how.seed, 91])
    network = Network(len(NETWORK_CLASSES)).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if how.start is not None:
        network.load_state_dict(torch.load(how.start))
    weights = class_weights(views.shares(len(NETWORK_CLASSES)))
    mean = torch.optim.swa_utils.AveragedModel(
        network, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(_AVERAGED), use_buffers=True
    )
    optimisers = _optimisers(network, how.rate)
    order, clock, total = epochs(len(views), rng), Clock(how), 0.0
    network.train()
    step, done = 0, 0.0
    while done < 1.0:
        for group in (group for optimiser in optimisers for group in optimiser.param_groups):
            group["lr"] = how.rate * rate_share(done)
        picture, label = batch(views, rng, [next(order) for _ in range(_BATCH)], how.sought)
        down, right = rng.integers(0, 2, 2)  # each logit stands for four pixels, which teach it in turns
        taught = torch.from_numpy(label[:, down::2, right::2].astype(np.int64))
        pictures = torch.from_numpy(picture).contiguous(memory_format=torch.channels_last)
        loss = loss_of(network(pictures), taught, weights)
        network.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 2.0)
        for optimiser in optimisers:
            optimiser.step()
        mean.update_parameters(network)
        total += float(loss.detach())
        step += 1
        done = clock.done(step)
        if step % _REPORT_EVERY == 0:
            print(
                f"{step} ({done:.0%}): loss {total / _REPORT_EVERY:.4f}, {clock.cpu_s():.0f} s CPU",
                flush=True,
            )
            total = 0.0
        if step % _WRITE_EVERY == 0 or done >= 1.0:
            torch.save(mean.module.state_dict(), out)
    learnt = mean.module
    assert isinstance(learnt, Network)
    return learnt.eval()


def _optimisers(network: Network, rate: float) -> list[torch.optim.Optimizer]:
    """Muon for what mixes channels within the network; AdamW for its first and last layer, filters and biases."""
    inner, others = [], []
    for name, p in network.named_parameters():
        mixes = p.ndim == 2 or (p.ndim == 4 and p.shape[1] > 1)
        (inner if mixes and not name.startswith(("stem.", "logits.")) else others).append(p)
    flat = [p for p in others if p.ndim == 1]
    groups = [{"params": [p for p in others if p.ndim > 1]}, {"params": flat, "weight_decay": 0.0}]
    return [Muon(inner, rate, _DECAY), torch.optim.AdamW(groups, lr=rate, weight_decay=_DECAY)]


def confusion(network: Network, views: Views) -> NDArray[np.int64]:
    """Pixels (true class, class found) of whole views."""
    count = len(NETWORK_CLASSES)
    out = np.zeros((count, count), np.int64)
    with torch.inference_mode():
        for photo, label in zip(views.photos, views.labels, strict=True):
            cells = network(torch.from_numpy(whole(photo)))[0].argmax(dim=0).numpy().astype(np.uint8)
            found = cv2.resize(cells, label.shape[::-1], interpolation=cv2.INTER_NEAREST)
            known = label != IGNORED
            pairs = label[known].astype(np.int64) * count + found[known]
            out += np.bincount(pairs, minlength=count * count).reshape(count, count)
    return out


def main(arguments: Sequence[str] | None = None) -> int:
    """Train, say how good it is on the views kept apart, write the weights."""
    parser = argparse.ArgumentParser(prog="python training/train.py")
    parser.add_argument("--views", type=Path, required=True)
    parser.add_argument("--check", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=2400)
    parser.add_argument("--minutes", type=float, default=0.0, help="of wall time at most (default: no limit)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--start", type=Path, help="weights to go on from")
    parser.add_argument("--rate", type=float, default=_RATE, help="learning rate at its highest")
    parser.add_argument("--sought", type=float, default=0.7, help="share of crops that look for a class")
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    views = Views(list(given.views.glob("*.npz")))
    print(f"{len(views)} views", flush=True)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    how = Plan(given.steps, given.minutes, given.seed, given.sought, given.rate, given.start)
    network = train(views, how, given.out)
    for world in sorted({p.name.split("-")[0] for p in given.check.glob("*.npz")}):
        table = confusion(network, Views(list(given.check.glob(f"{world}-*.npz"))))
        there = table.sum(axis=1) > 0
        iou = np.diag(table) / np.maximum(table.sum(axis=0) + table.sum(axis=1) - np.diag(table), 1)
        said = ", ".join(
            f"{name} {value:.3f}"
            for name, value, is_there in zip(NETWORK_CLASSES, iou, there, strict=True)
            if is_there
        )
        print(f"{world}: mean {iou[there].mean():.3f}; {said}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
