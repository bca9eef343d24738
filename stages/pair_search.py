"""Search for the sizes of two faults at once: Newton's steps on their likelihood.

Where to begin, and whether at all, is said by what each does alone (:mod:`stages.additive`).
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.alarm_window import Window
from stages.hypotheses import Hypothesis

Array = NDArray[np.float64]
SETTLED = 0.02  # standard deviations that a last step of Newton's is at most
GAIN, IDLE = 0.05, 2  # what a step gains at least, else so many in a row are the last
STENCIL = np.array(
    [[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [1, -1], [-1, 1], [-1, -1]], dtype=float
)


@dataclass(frozen=True)
class Pair:
    """Two faults: how evident they are beside the likeliest single fault and beside `unknown`, the logarithm
    of the share of all sizes that theirs make, the sizes and their standard deviations."""

    height: float
    over_unknown: float
    share: float
    sizes: tuple[float, float]
    sds: tuple[float, float]


Two = tuple[Hypothesis, Hypothesis]
Steps = Generator[Array, Array, Pair]


class Search(NamedTuple):
    """For the sizes of two hypotheses: their numbers, and ``steps`` that yield sizes (K, 2) and are sent L
    (K,) of them."""

    which: tuple[int, int]
    steps: Steps


def sought(window: Window, searches: Mapping[str, Search]) -> dict[str, Pair]:
    """What searches come to, by name; what all of them ask for at a time is computed at once."""
    asked, found = {name: next(search.steps) for name, search in searches.items()}, dict[str, Pair]()
    while asked:
        which = [np.tile(searches[name].which, (len(x), 1)) for name, x in asked.items()]
        L = window.both(np.concatenate(which), np.concatenate([*asked.values()]))
        answers = np.split(L, np.cumsum([len(x) for x in asked.values()])[:-1])
        waiting, asked = zip([*asked], answers, strict=True), {}
        for name, answer in waiting:
            try:
                asked[name] = searches[name].steps.send(answer)
            except StopIteration as end:
                found[name] = end.value
    return {name: found[name] for name in searches}


def begun(hypotheses: Two, first: Sequence[float], second: Sequence[float]) -> Steps:
    """From the likeliest of the sizes ``first`` and ``second``."""
    sizes = np.array([*product(first, second)])
    L = yield sizes
    return (yield from refined(hypotheses, sizes[int(L.argmax())], 12))


def refined(hypotheses: Two, start: Pair | Array, steps: int) -> Steps:
    """The pair near ``start`` that is most likely, by Newton's steps on differences."""
    grids = [np.array(h.sizes) for h in hypotheses]
    at = np.array(start.sizes) if isinstance(start, Pair) else start
    h = np.array([0.5 * np.abs(np.diff(g)).min() for g in grids])
    if isinstance(start, Pair):
        h = np.minimum(h, start.sds)
    low, high = (np.array([f(g) for g in grids]) for f in (np.min, np.max))
    best, top, C, idle = at, -np.inf, np.diag(h**2), 0
    for _ in range(steps):
        L = yield at + STENCIL * h
        idle = 0 if L.max() > top + GAIN else idle + 1
        if L.max() > top:
            best, top = at + STENCIL[int(L.argmax())] * h, float(L.max())
        if idle == IDLE:
            break
        gradient = np.array([L[1] - L[2], L[3] - L[4]]) / (2 * h)
        H = np.diag([L[1] - 2 * L[0] + L[2], L[3] - 2 * L[0] + L[4]]) / h**2
        H[0, 1] = H[1, 0] = (L[5] - L[6] - L[7] + L[8]) / (4 * h[0] * h[1])
        if (np.linalg.eigvalsh(H) < 0).all():
            C = -np.linalg.inv(H)
            step = C @ gradient
            if (np.abs(step) < SETTLED * np.sqrt(np.diag(C))).all():
                break
            at = at + np.clip(step, -4 * h, 4 * h)
            h = np.clip(np.sqrt(np.diag(C)), 0.25 * h, h)
        else:
            at = best
        at = np.clip(at, low, high)
    sds = np.sqrt(np.diag(C))
    width = 2 * np.pi * np.sqrt(max(np.linalg.det(C), 0.0)) / np.prod(high - low)
    share = float(np.log(min(1.0, max(width, 1e-300))))
    return Pair(top + share, -np.inf, share, (float(best[0]), float(best[1])), (float(sds[0]), float(sds[1])))
