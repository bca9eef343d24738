"""Deciding: which fault explains how the indicators have changed, over windows, with one that explains none.

For every hypothesis a moving average of what it leaves unexplained is kept
(:class:`stages.tracking.Average`), so that R = h' cov(h)^-1 h is chi-squared if it is true, however its
size moves; for ``none`` all of d is unexplained. With the size's standard deviation v after averaging and s
that of sizes a priori, the evidence for a fault is

    evidence_f = 1/2 (R_none - R_f) - 1/2 ln(1 + s^2 / v^2),

a logarithm of a ratio of marginal likelihoods to ``none``. ``unknown`` is any change of any indicators with
standard deviation s each, d ~ N(0, S + s^2 I). It pays for its freedom, so it wins only where all templates
leave much unexplained: it is the template residual test, with its threshold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.templates import Template
from stages.tracking import Average
from stages.trend import Trend

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Belief:
    """What is remembered: averages of d itself and of each template's rest, sums ``(sum w a, sum w^2 a)``
    of the information a on each size (faults, 2), the sizes' trends, and the number of windows."""

    whole: Average
    rests: tuple[Average, ...]
    sizes: Array
    trends: tuple[Trend, ...]
    windows: int


@dataclass(frozen=True, kw_only=True)
class Decision:
    """``forgetting`` by window; ``change_sd``: s; ``floor``: changes smaller than this may be the model's.

    Windows that overlap tell the same twice: with new samples only in a ``share`` of each, that share of its
    information counts, so that M is right for averages over many windows."""

    templates: tuple[Template, ...]
    forgetting: float
    change_sd: float
    floor: float
    share: float = 1.0

    def start(self) -> Belief:
        count = len(self.templates)
        k = len(self.templates[0].indicators) if count else 0
        empty = Average.empty(k)
        return Belief(
            whole=empty, rests=(empty,) * count, sizes=np.zeros((count, 2)),
            trends=(Trend.at(0.0, 0.0),) * count, windows=0,
        )  # fmt: skip

    def add(self, belief: Belief, d: Array, covariance: Array) -> Belief:
        """After one more window that measured the change d (k,) with ``covariance``."""
        k, g = len(d), 1.0 - (1.0 - self.forgetting) ** self.share
        information = self.share * _inverse(covariance + self.floor**2 * np.eye(k))
        splits = [t.split(d, information) for t in self.templates]
        weights = np.array([[s.weight, s.weight] for s in splits])
        return Belief(
            whole=belief.whole.add(d, information, g),
            rests=tuple(a.add(s.rest, s.information, g) for a, s in zip(belief.rests, splits, strict=True)),
            sizes=belief.sizes * np.array([1.0 - g, (1.0 - g) ** 2]) + weights * np.array([g, g * g]),
            trends=tuple(
                t.follow(s.eta, 1.0 / s.weight, self.share)
                for t, s in zip(belief.trends, splits, strict=True)
            ),
            windows=belief.windows + 1,
        )

    def evidence(self, belief: Belief, reference: Array) -> Array:
        """Evidence of each fault and, last, of ``unknown``; ``reference``: covariance of the healthy
        values."""
        none = belief.whole.squares(reference)
        out = []
        for i, rest in enumerate(belief.rests):
            total, squared = belief.sizes[i]
            variance = squared / total**2
            left = rest.squares(reference)
            out.append(0.5 * (none - left - np.log1p(self.change_sd**2 / variance)))
        return np.array([*out, self._unknown(*belief.whole.mean(reference))])

    def size(self, belief: Belief, fault: int, reference: Array, windows: float) -> tuple[float, float]:
        """eta of a fault that many windows after the last one's centre, and its standard deviation with
        that of the healthy values."""
        eta, sd = belief.trends[fault].ahead(windows)
        healthy = self.templates[fault].split(np.zeros(len(reference)), _inverse(reference)).weight
        return eta, float(np.hypot(sd, healthy**-0.5))

    def _unknown(self, d: Array, S: Array) -> float:
        values, vectors = np.linalg.eigh(S)
        along, free = (vectors.T @ d) ** 2, values + self.change_sd**2
        return float(0.5 * (along / values - along / free - np.log(free / values)).sum())


def _inverse(M: Array) -> Array:
    return np.asarray(np.linalg.inv(M), dtype=np.float64)


def probabilities(evidence: Array) -> Array:
    """The softmax: all hypotheses are equally probable a priori."""
    p = np.exp(evidence - evidence.max())
    return np.asarray(p / p.sum())
