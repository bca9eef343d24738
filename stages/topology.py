"""Topology: how large a map, and how its regions hang together, by cross-validation (future work, 6.2).

Candidates are sizes of the map, each with its regions blended, or hard with the neighbourhood's weights
(5.49) along the map's edges at two widths. Each is grown and fitted on three of four stretches of the samples
and predicts the fourth; its score is the weighted root mean square error over all four, its uncertainty that
of the mean over ``BLOCKS`` stretches, paired with the best candidate's. The smallest map that is not worse
than the best one by more than one standard error is chosen (Breiman et al. 1984).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ingest.errors import LogError
from stages.gsmms import Combination, fit_gsmms
from stages.partition import Growth

Array = NDArray[np.float64]
FOLDS, BLOCKS, ROWS = 4, 20, 6000


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A structure, its held-out root mean square error, and the standard error of its mean square's distance
    to the best one's, as a root mean square error."""

    nodes: int
    combination: Combination
    neighbourhood: float
    rms: float
    se: float


@dataclass(frozen=True, kw_only=True)
class Study:
    """All candidates, and the place of the chosen one."""

    candidates: tuple[Candidate, ...]
    place: int

    @property
    def chosen(self) -> Candidate:
        return self.candidates[self.place]

    def to_arrays(self) -> dict[str, NDArray[np.float64]]:
        """One row per candidate: nodes, 1 if blended, neighbourhood, rms, se, 1 if chosen."""
        rows = [
            [c.nodes, c.combination == "blended", c.neighbourhood, c.rms, c.se, i == self.place]
            for i, c in enumerate(self.candidates)
        ]
        return {"study": np.array(rows, dtype=float)}


def study(
    S: Array,
    y: Array,
    weight: Array,
    own: Array,
    sizes: Sequence[int],
    samples_per_parameter: float,
    neighbourhoods: Sequence[float] = (0.4, 0.8),
) -> Study:
    """Compare map sizes for ``y`` (N,) on normalised regressors ``S`` (N, d); weights as in
    :func:`stages.gsmms.fit_gsmms`. Of more than ``ROWS`` complete rows every n-th counts.

    Raises:
        LogError: too few complete rows for the smallest map.
    """
    known = np.isfinite(S).all(axis=1) & np.isfinite(y) & (weight > 0)
    step = max(1, -(-int(known.sum()) // ROWS))
    S, y, weight, own = (x[known][::step] for x in (S, y, weight, own))
    folds = np.minimum(np.arange(len(y)) * FOLDS // max(len(y), 1), FOLDS - 1)
    found: list[tuple[int, Combination, float, Array]] = []
    for nodes in sorted({*sizes}):
        growth = Growth(nodes=nodes, samples_per_parameter=samples_per_parameter)
        kinds: list[tuple[Combination, float]] = [("blended", neighbourhoods[0])]
        kinds += [("hard", n) for n in neighbourhoods] if nodes > 1 else []
        for combination, near in kinds:
            square = np.empty(len(y))
            try:
                for fold in range(FOLDS):
                    seen, left = folds != fold, folds == fold
                    model = fit_gsmms(
                        S[seen], y[seen], weight[seen], own[seen], growth=growth, combination=combination,
                        neighbourhood=near,
                    )  # fmt: skip
                    square[left] = (y[left] - model.predict(S[left])) ** 2
            except LogError:
                if not found:
                    raise
                continue
            found.append((nodes, combination, near, square))
    return _chosen(found, weight * own)


def _chosen(found: Sequence[tuple[int, Combination, float, Array]], w: Array) -> Study:
    means = [float(np.average(square, weights=w)) for *_, square in found]
    best = int(np.argmin(means))
    part = np.minimum(np.arange(len(w)) * BLOCKS // len(w), BLOCKS - 1)
    mass = np.bincount(part, w, minlength=BLOCKS)
    candidates, within = [], []
    for (nodes, combination, near, square), mean in zip(found, means, strict=True):
        away = np.bincount(part, w * (square - found[best][3]), minlength=BLOCKS)[mass > 0] / mass[mass > 0]
        se = float(away.std(ddof=1) / np.sqrt(len(away))) if len(away) > 1 else 0.0
        within.append(mean <= means[best] + se)
        rms = float(np.sqrt(mean))
        spread = se / (2 * rms) if rms > 0 else 0.0
        candidates.append(
            Candidate(nodes=nodes, combination=combination, neighbourhood=near, rms=rms, se=spread)
        )
    order = sorted(range(len(found)), key=lambda i: (not within[i], candidates[i].nodes, candidates[i].rms))
    return Study(candidates=tuple(candidates), place=order[0])
