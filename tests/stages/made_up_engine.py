"""A made-up engine with two relations and three faults that move them in different ways."""

from __future__ import annotations

import numpy as np
import polars as pl

from ingest.log import Group, Log
from stages.hypotheses import Hypothesis
from stages.isolate import Isolate
from stages.normalise import Normalise
from stages.regressors import Regressors
from stages.relation import Relation
from stages.relations import Relations
from stages.residuals import Residuals
from stages.stage import ANALYSIS, Learner, Stage, connected, transform

GRID = (-0.1, -0.07, -0.05, -0.04, -0.03, -0.02, -0.01, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.1)
HYPOTHESES = {
    "flow_gain": Hypothesis(undo={"W": "W / (1 + theta)"}, sizes=GRID, signal="W"),
    "pressure_gain": Hypothesis(undo={"p": "p / (1 + theta)"}, sizes=GRID, signal="p"),
    "leak": Hypothesis(undo={"leak": "theta * p"}, sizes=(0.5, 1.0, 1.5, 2.0, 2.5, 3.0), unit="mm"),
}
STAGES: tuple[Stage, ...] = (
    Regressors(columns={"net": "W - leak", "air": "ln(net / (p * n))", "fuel": "ln(net / F)"}),
    Normalise(columns=("p", "n", "F")),
    Relations(
        relations={
            "f_air": Relation(output="air", inputs=("p", "n"), nodes=6),
            "f_fuel": Relation(output="fuel", inputs=("F", "n"), nodes=6),
        },
        regime="f_air",
        map=("n", "p"),
    ),
    Residuals(residuals={"r_air": "air - f_air", "r_fuel": "fuel - f_fuel"}),
    Isolate(hypotheses=HYPOTHESES, offsets={"r_air": {"1": 0.002}, "r_fuel": {"1": 0.002}}),
)


def drive(
    seed: int, *, flow: float = 0.0, pressure: float = 0.0, leak: float = 0.0, at: float = 200.0
) -> Log:
    """An engine whose air flow is ``0.4 p n`` (a little less at high speed), fuelled for it; 600 s at 2
    Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 600, 0.5)
    p = 1.5 + 0.5 * np.sin(2 * np.pi * t / 61 + rng.uniform(0, 6))
    n = 2.0 + 0.8 * np.sin(2 * np.pi * t / 83 + rng.uniform(0, 6))
    W = 40 * p * n * (1 - 0.05 * n)
    F = W / 20 * np.exp(rng.normal(0, 0.005, t.size))
    on = t >= at
    logged = pl.DataFrame(
        {
            "time": t,
            "W": (W + leak * p * on) * (1 + flow * on) * np.exp(rng.normal(0, 0.005, t.size)),
            "p": p * (1 + pressure * on) * np.exp(rng.normal(0, 0.002, t.size)),
            "n": n,
            "F": F,
            "leak": np.zeros(t.size),
        }
    )
    return Log(f"drive{seed}", {ANALYSIS: Group(ANALYSIS, logged)})


def fitted_to(stages: tuple[Stage, ...]) -> list[Stage]:
    """The chain, trained on one drive and calibrated on another."""
    out: list[Stage] = []
    train, block = drive(1), drive(2)
    for stage in stages:
        ready = stage
        if isinstance(stage, Learner):
            source = train if stage.learns_from == "training" else block
            ready = stage.fit([source], [out])
        out = connected([*out, ready])
        train, block = transform(out[-1:], train), transform(out[-1:], block)
    return out
