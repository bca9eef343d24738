"""Criteria: how well regressors explain an output, against how many there are; the least is best.

Of a common partition in M regions, with ``n`` regressors, ``k = n + 1`` parameters with the constant, ``N_m``
rows and residual sums of squares ``RSS_m``:

- ``pooled`` (default): ``N ln(sum RSS_m / N) + sum N_m ln(N_m) (k + 1) / (N_m - k - 2)``, the minimum
  description length of (4.15), free of the output's scale;
- ``printed``: (4.15) as it stands, ``sum (RSS_m / N_m + ln(N_m) (n + 1) / (N_m - n - 2))``. It sets errors in
  the output's unit against a pure number, and selects too few;
- ``scaled``: the same with the output in units of the residual standard deviation of the largest model;
- ``bic``: ``N ln(sum RSS_m / N) + k M ln N``;  ``aic``: ``... + 2 k M``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from stages.gram import Gram

Array = NDArray[np.float64]
Criterion = Literal["pooled", "printed", "scaled", "bic", "aic"]
CRITERIA: tuple[str, ...] = get_args(Criterion)
NEVER = 1e-300  # a residual sum of squares is never taken as smaller than this


@dataclass(frozen=True, eq=False)
class Score:
    """``f = N ln(r / N) + penalty[n]`` or ``f = r + penalty[n]``, with ``r = sum_m weight_m RSS_m``."""

    rows: float
    weight: Array
    penalty: Array
    logarithm: bool

    def __call__(self, r: Array | float, n: NDArray[np.integer] | int) -> Array:
        fit = self.rows * np.log(np.maximum(r, NEVER) / self.rows) if self.logarithm else np.asarray(r)
        return np.asarray(fit + self.penalty[n])

    def of(self, gram: Gram, columns: tuple[int, ...]) -> float:
        """The criterion of the candidates ``columns``."""
        return float(self(float(self.weight @ gram.rss(columns)), len(columns)))


def score_of(criterion: Criterion, gram: Gram, scale: float = 1.0) -> Score:
    """The criterion for a Gram matrix whose output was divided by ``scale``."""
    N_m, K = gram.counts[gram.counts > 0], gram.G.shape[0] - 1
    N, M = float(N_m.sum()), len(N_m)
    n = np.arange(K + 1)[:, None]
    one = np.ones(len(gram.counts))
    if criterion in ("bic", "aic"):
        per_parameter = np.log(N) if criterion == "bic" else 2.0
        return Score(N, one, per_parameter * M * (n[:, 0] + 1.0), True)
    if criterion == "pooled":
        return Score(N, one, _description(N_m, n + 1).sum(axis=1), True)
    unit = scale**2
    if criterion == "scaled":
        unit = N / max(float(gram.rss(range(K)).sum()), NEVER)
    each = unit / np.maximum(gram.counts, 1.0)
    return Score(N, each, (_description(N_m, n) / N_m).sum(axis=1), False)


def _description(N_m: Array, n: NDArray[np.int64]) -> Array:
    """``N_m ln(N_m) (n + 1) / (N_m - n - 2)``, infinite where a region has too few rows."""
    left = N_m - n - 2
    return np.where(left > 0, N_m * np.log(N_m) * (n + 1) / np.where(left > 0, left, 1.0), np.inf)
