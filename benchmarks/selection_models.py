"""The final models on fresh data: smooth and hard regions in the selected inputs, and others' partitions."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.stats import kstest

from benchmarks.selection_cases import Case, examples, show, system_case
from benchmarks.systems import SYSTEMS
from stages.curved import curved_map
from stages.gsmms import fit_gsmms
from stages.partition import Growth

Array = NDArray[np.float64]
Predict = Callable[[Array], Array]
Fit = Callable[[Array, Array, int], Predict]  # of regressors, output and a number of regions
LIMITS = {"y1": 1.006, "y2": 1.015, "y": 1.012, "Narendra's rational": 1.15}
FRESH = 10**6  # added to a seed for the data that a model is judged on


@dataclass(eq=False)
class Scores:
    rms: list[float] = field(default_factory=list)
    normal: int = 0
    seconds: list[float] = field(default_factory=list)

    def add(self, case: Case, fit: Fit, fresh: Case, regions: int) -> None:
        X, y = case.regressors()
        began = time.process_time()
        predict = fit(X, y, regions)
        self.seconds.append(time.process_time() - began)
        Z, target = fresh.regressors()
        e = target - predict(Z)
        self.rms.append(float(np.sqrt(np.mean(e**2)) / case.noise))
        self.normal += bool(kstest((e - e.mean()) / e.std(), "norm").pvalue > 0.05)


def curved(X: Array, y: Array, _: int) -> Predict:
    """The final model of recipe narx."""
    T, partition = curved_map(X, y, np.ones(len(y)))
    model = fit_gsmms(X @ T, y, partition=partition)
    return lambda Z: model.predict(Z @ T)


def curved_hard(X: Array, y: Array, _: int) -> Predict:
    T, partition = curved_map(X, y, np.ones(len(y)))
    model = fit_gsmms(X @ T, y, combination="hard", partition=partition)
    return lambda Z: model.predict(Z @ T)


def map_blended(X: Array, y: Array, regions: int) -> Predict:
    return _on_map(X, y, regions, "blended")


def map_hard(X: Array, y: Array, regions: int) -> Predict:
    return _on_map(X, y, regions, "hard")


def _on_map(X: Array, y: Array, regions: int, combination: str) -> Predict:
    centre, scale = X.mean(axis=0), X.std(axis=0)
    model = fit_gsmms(
        (X - centre) / scale, y, growth=Growth(nodes=regions), combination=combination, neighbourhood=0.05  # type: ignore[arg-type]
    )  # fmt: skip
    return lambda Z: model.predict((Z - centre) / scale)


def linear(X: Array, y: Array, _: int) -> Predict:
    A = np.column_stack([np.ones(len(X)), X])
    theta = np.linalg.lstsq(A, y, rcond=None)[0]
    return lambda Z: np.asarray(theta[0] + Z @ theta[1:])


def cases(n: int, seed: int) -> Iterator[tuple[Case, Case]]:
    """Training data and fresh data of the same system."""
    yield from zip(examples(n, seed), examples(n, seed + FRESH), strict=True)
    yield system_case(SYSTEMS[0], n, seed), system_case(SYSTEMS[0], n, seed + FRESH)


def run(seeds: Sequence[int]) -> None:
    """Part 4."""
    ways: dict[str, Fit] = {"smooth": curved, "hard, same regions": curved_hard, "single linear": linear}
    scores: dict[tuple[str, str], Scores] = {}
    for seed in seeds:
        for case, fresh in cases(4000, seed):
            for way, fit in ways.items():
                scores.setdefault((case.name, way), Scores()).add(case, fit, fresh, 32)
    for (name, way), s in scores.items():
        mean, least = float(np.mean(s.rms)), round(25 / 30 * len(seeds))
        limit = LIMITS[name] if way == "smooth" else None
        show(
            4, f"{name}: {way}, RMS over the noise, mean of {len(seeds)}",
            f"{mean:.4f} (max {max(s.rms):.3f}), normal {s.normal}, {np.median(s.seconds):.2f} s",
            f"<= {limit}, normal >= {least}" if limit else "",
            mean <= limit and s.normal >= least if limit else None,
        )  # fmt: skip
