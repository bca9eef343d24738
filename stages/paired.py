"""Paired: is a challenger better than the champion, given few drives that both were replayed on?

Of each drive i and detector there is a value, for each resampling of the calibration drives another where it
depends on thresholds. The difference ``d = sum_i w_i (challenger_i - champion_i) / sum_i w_i``, with a sign
so that more is better, is bootstrapped over drives and calibration drives at once; the percentile interval is
widened about d by ``t_{n-1} / z sqrt(n / (n - 1))``, as few drives vary less than their kind does. A share in
which no drive differs says no more than +-3 / n, a rate of which the weights are the hours no more than +-3 /
sum w (the rule of three).

With the interval (low, high), a zone ``same`` that nobody would call a difference and ``margin``, the loss
that is accepted: better if low > same, worse if high < -same, not worse if low > -margin, else undecided.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t

Array = NDArray[np.float64]
BETTER, NOT_WORSE, WORSE, UNDECIDED = "better", "not worse", "worse", "undecided"
Verdict = Literal["better", "not worse", "worse", "undecided"]


@dataclass(frozen=True, kw_only=True)
class Interval:
    """A difference with its interval and what that says; ``drives`` that it counts."""

    champion: float
    challenger: float
    difference: float
    low: float
    high: float
    drives: int
    verdict: Verdict

    def to_json(self) -> dict[str, Any]:
        """Plain values; None where a number is not finite."""
        return {
            k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in asdict(self).items()
        }


def compare(
    champion: Array,
    challenger: Array,
    weight: Array,
    rng: np.random.Generator,
    *,
    more_is_better: bool,
    same: float = 0.0,
    margin: float = 0.02,
    share: bool = False,
    rate: bool = False,
    level: float = 0.95,
) -> Interval | None:
    """Compare values of shape (resamplings, drives), row 0 being that of the detectors as they are; drives
    where one of them has no value do not count. None where no drive does.

    >>> one = np.ones((1, 40)); two = one - 0.5 * (np.arange(40) % 2)
    >>> compare(one, two, np.ones(40), np.random.default_rng(0), more_is_better=True).verdict
    'worse'
    """
    known = np.isfinite(champion).all(axis=0) & np.isfinite(challenger).all(axis=0) & (weight > 0)
    n = int(known.sum())
    if n == 0:
        return None
    a, b, w = champion[:, known], challenger[:, known], weight[known]
    d = (b - a) * (1.0 if more_is_better else -1.0)
    mean = float(np.average(d[0], weights=w))
    low, high = _interval(d, w, mean, rng, level)
    if (share or rate) and not d.any():
        bound = 3.0 / float(w.sum()) if rate else min(1.0, 3.0 / n)
        low, high = -bound, bound
    return Interval(
        champion=float(np.average(a[0], weights=w)), challenger=float(np.average(b[0], weights=w)),
        difference=mean, low=low, high=high, drives=n, verdict=_verdict(low, high, same, margin),
    )  # fmt: skip


def _verdict(low: float, high: float, same: float, margin: float) -> Verdict:
    if low > same:
        return "better"
    if high < -same:
        return "worse"
    return "not worse" if low > -margin else "undecided"


def _interval(
    d: Array, w: Array, mean: float, rng: np.random.Generator, level: float, count: int = 2000
) -> tuple[float, float]:
    """Bounds of the difference; without bounds for a single drive that differs."""
    n = d.shape[1]
    if n == 1:
        return (-np.inf, np.inf) if d.any() else (0.0, 0.0)
    drive = rng.integers(n, size=(count, n))
    row = rng.integers(len(d), size=count) if len(d) > 1 else np.zeros(count, dtype=int)
    means = (w[drive] * d[row[:, None], drive]).sum(axis=1) / w[drive].sum(axis=1)
    tail = 0.5 * (1 - level)
    low, high = np.quantile(means, [tail, 1 - tail])
    wider = float(t.ppf(1 - tail, n - 1) / norm.ppf(1 - tail) * np.sqrt(n / (n - 1)))
    return float(mean + wider * min(low - mean, 0.0)), float(mean + wider * max(high - mean, 0.0))
