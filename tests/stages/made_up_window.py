"""A window of an alarm whose likelihood is known."""

from __future__ import annotations

import numpy as np

from stages.alarm_window import Window
from stages.hypotheses import ELAPSED, Hypothesis, Points
from stages.size_grid import refined_grid

N, SD = 30, 0.3
REGIME = np.arange(N) % 3
NOISE, MODEL = 0.5, 0.2
HYPOTHESES = [
    Hypothesis(
        undo={"residual.r": "`residual.r` - theta"}, sizes=(1.0, 2.0), inexact=0.1, blur="0.5 * `offset.r`"
    ),
    Hypothesis(undo={"residual.r": "`residual.r` - 2 * theta"}, sizes=(1.0, 2.0)),
]


def made_up_window() -> Window:
    """Of one residual, with what its samples share in every way."""
    points = Points(HYPOTHESES, [], ["r"])
    e = np.random.default_rng(8).normal(1.0, 0.6, N)
    values = {
        "residual.r": e, "sigma.r": np.full(N, np.hypot(NOISE, MODEL)), "model_sd.r": np.full(N, MODEL),
        "novelty.r": np.zeros(N), "regime": REGIME, ELAPSED: np.arange(float(N)),
    }  # fmt: skip
    grid = refined_grid(HYPOTHESES, points.sizes, 0, 1)
    shapes = np.stack([np.ones((N, 1)), np.zeros((N, 1))], axis=2)
    return Window(points, grid, values, shapes, np.array([[SD, 0.0]]), np.ones((N, 1)), np.inf)
