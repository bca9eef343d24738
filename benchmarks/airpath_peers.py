"""Air-path diagnosis with other regressors, and detection with methods that know no relations.

    python -m benchmarks.airpath_peers [--seeds N] [--folder FOLDER]

Wants scikit-learn. The recipe, its regime map, its isolation and its calibration are the same for all; only
what predicts from the relations' inputs is exchanged: GSMMS, one plane, a global quadratic, a neural network
(20-20) and gradient boosting, the last two with their library's defaults. For detection: T2 and SPE of a
principal component analysis of the signals, and an isolation forest, each with the largest 30 s mean of the
calibration logs as its threshold. As in :mod:`benchmarks.airpath`: trained on one WLTC, without tolerances,
drives not tuned on. With FOLDER the regressors instead judge the petrol engine's logs of
:mod:`benchmarks.liu_bench`.
"""

from __future__ import annotations

import argparse
import importlib
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

import stages.relation
from benchmarks.airpath import CALIBRATION, LENGTH_S
from benchmarks.liu_bench import read_logs, table
from ingest.log import Log
from ingest.simulators.airpath import Fault, simulate_airpath
from pipeline.detector import Detector
from pipeline.diagnosing import diagnose
from pipeline.fitting import fit
from pipeline.recipe import load_recipe
from stages.evaluation import Evaluation
from stages.gate import GATE
from stages.gsmms import Gsmms
from stages.relations import Relations
from stages.stage import columns, transform

Array = NDArray[np.float64]
Model = Callable[[Array], Array]
FIRST_SEED = 9600
FAULTS = [
    ("maf_gain", -0.02), ("maf_gain", 0.02), ("boost_pressure_gain", 0.005), ("intake_pressure_gain", 0.005),
    ("boost_leak", 3.0), ("boost_leak", 6.0), ("intake_leak", 3.0), ("intake_leak", 6.0),
]  # fmt: skip
SIGNALS = ["p_Bst", "p_Int", "T_Int", "T_Bst", "W_HFM", "n_Eng"]


def plane(S: Array, y: Array, weight: Array) -> Model:
    return _least_squares(lambda X: np.column_stack([np.ones(len(X)), X]), S, y, weight)


def quadratic(S: Array, y: Array, weight: Array) -> Model:
    def features(X: Array) -> Array:
        i, j = np.triu_indices(X.shape[1])
        return np.column_stack([np.ones(len(X)), X, X[:, i] * X[:, j]])

    return _least_squares(features, S, y, weight)


def _least_squares(features: Callable[[Array], Array], S: Array, y: Array, weight: Array) -> Model:
    root = np.sqrt(weight)
    theta = np.linalg.lstsq(features(S) * root[:, None], y * root, rcond=None)[0]
    return lambda X: np.asarray(features(X) @ theta)


def network(S: Array, y: Array, weight: Array) -> Model:
    net = importlib.import_module("sklearn.neural_network")
    rows = weight > 0.2
    centre, scale = y[rows].mean(), y[rows].std() or 1.0
    model = net.MLPRegressor(hidden_layer_sizes=(20, 20), max_iter=2000, random_state=0).fit(
        S[rows], (y[rows] - centre) / scale
    )
    return lambda X: np.asarray(centre + scale * model.predict(X))


def boosting(S: Array, y: Array, weight: Array) -> Model:
    ensemble = importlib.import_module("sklearn.ensemble")
    model = ensemble.HistGradientBoostingRegressor(random_state=0).fit(S, y, sample_weight=weight)
    return lambda X: np.asarray(model.predict(X))


PEERS: dict[str, Callable[[Array, Array, Array], Model] | None] = {
    "GSMMS": None, "one plane": plane, "global quadratic": quadratic, "network 20-20": network,
    "gradient boosting": boosting,
}  # fmt: skip


@contextmanager
def regressor(peer: Callable[[Array, Array, Array], Model] | None) -> Iterator[None]:
    """Every relation predicts with ``peer``; regime, domain and all else stay as they are."""
    if peer is None:
        yield
        return
    known: dict[bytes, Model] = {}
    fit_gsmms, evaluate = stages.relation.fit_gsmms, Gsmms.evaluate

    def fitted(S: Array, y: Array, weight: Array, own: Array, **settings: object) -> Gsmms:
        model = fit_gsmms(S, y, weight, own, **settings)  # type: ignore[arg-type]
        rows = np.isfinite(S).all(axis=1) & np.isfinite(y) & (weight * own > 0)
        known[model.theta.tobytes()] = peer(S[rows], y[rows], (weight * own)[rows])
        return model

    def evaluated(self: Gsmms, S: Array) -> Evaluation:
        found, model = evaluate(self, S), known.get(self.theta.tobytes())
        if model is None:
            return found
        prediction, rows = np.full(len(S), np.nan), np.isfinite(S).all(axis=1)
        if rows.any():
            prediction[rows] = model(S[rows])
        return found._replace(prediction=prediction, doubt=np.zeros(len(S)))

    with patch.object(stages.relation, "fit_gsmms", fitted), patch.object(Gsmms, "evaluate", evaluated):
        yield


@dataclass(frozen=True)
class Drive:
    log: Log
    fault: str


def drives(seeds: int) -> list[Drive]:
    found = []
    for cycle, length in LENGTH_S.items():
        calm = range(FIRST_SEED, FIRST_SEED + 3 * seeds)
        found += [Drive(simulate_airpath(cycle=cycle, seed=seed), "none") for seed in calm]
        for i, (name, size) in enumerate(FAULTS):
            for seed in range(FIRST_SEED + 20 * (i + 1), FIRST_SEED + 20 * (i + 1) + seeds):
                fault = Fault(name=name, magnitude=size, onset_s=length / 3)
                found.append(Drive(simulate_airpath(cycle=cycle, seed=seed, faults=[fault]), name))
    return found


def calibration() -> list[Log]:
    return [simulate_airpath(cycle=c, seed=s, name=f"{c}_{s}") for c, s in CALIBRATION]


def matrix(detector: Detector, log: Log) -> tuple[Array, Array]:
    """Times and signals of the samples at rest."""
    place = next(i for i, s in enumerate(detector.stages) if isinstance(s, Relations))
    values = columns(transform(detector.stages[:place], log))
    rows = values[GATE] >= 0.5
    return values["time"][rows], np.column_stack([values[n][rows] for n in SIGNALS])


def alone(detector: Detector, training: Log, checked: list[Log]) -> dict[str, Callable[[Log], bool]]:
    """Detectors that know only how the signals were spread in training."""
    forest = importlib.import_module("sklearn.ensemble").IsolationForest(random_state=0)
    X = matrix(detector, training)[1]
    mean, sd = X.mean(axis=0), X.std(axis=0)
    _, s, V = np.linalg.svd((X - mean) / sd, full_matrices=False)
    k = int(np.searchsorted(np.cumsum(s**2) / (s**2).sum(), 0.95)) + 1
    forest.fit((X - mean) / sd)
    variance = s**2 / len(X)

    def t2(Z: Array) -> Array:
        return np.asarray(((Z @ V[:k].T) ** 2 / variance[:k]).sum(axis=1))

    def spe(Z: Array) -> Array:
        return np.asarray(((Z @ V[k:].T) ** 2 / variance[k:]).sum(axis=1))

    def odd(Z: Array) -> Array:
        return np.asarray(-forest.score_samples(Z))

    def highest(score: Callable[[Array], Array], log: Log) -> float:
        time, raw = matrix(detector, log)
        x = score((raw - mean) / sd)
        start = np.searchsorted(time, time - 30.0)
        total = np.append(0.0, np.cumsum(x))
        place = np.arange(len(x))
        known = place - start >= 10
        return float(((total[place + 1] - total[start]) / (place + 1 - start))[known].max(initial=-np.inf))

    def alarm(score: Callable[[Array], Array]) -> Callable[[Log], bool]:
        limit = max(highest(score, log) for log in checked)
        return lambda log: highest(score, log) > limit

    return {"PCA, T2": alarm(t2), "PCA, weighted SPE": alarm(spe), "isolation forest": alarm(odd)}


def bench(folder: Path) -> None:
    """The petrol engine's logs, fitted on the fault-free one."""
    logs = read_logs(folder)
    for name, peer in PEERS.items():
        with regressor(peer):
            table(name, fit([logs["NF"]], load_recipe("si_airpath")), logs, official=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2, help="per cycle and fault")
    parser.add_argument("--folder", type=Path, help="of the petrol engine's logs")
    args = parser.parse_args()
    if args.folder:
        bench(args.folder)
        return
    some = drives(args.seeds)
    healthy, faulty = [d for d in some if d.fault == "none"], [d for d in some if d.fault != "none"]
    training, checked, recipe = simulate_airpath(seed=0), calibration(), load_recipe("diesel_airpath")
    print(
        f"  {'':20s}false alarms /{len(healthy):<4d}detected /{len(faulty):<4d}named right   fit s  CPU s/log"
    )
    for name, peer in PEERS.items():
        with regressor(peer):
            start = time.process_time()
            detector = fit([training], recipe, checked)
            fitting = time.process_time() - start
            start = time.process_time()
            found = [diagnose(d.log, detector).verdict.fault for d in some]
            each = (time.process_time() - start) / len(some)
        calm = ("none", "insufficient_evidence")
        alarms = [f not in calm for f in found]
        false = sum(a for a, d in zip(alarms, some, strict=True) if d.fault == "none")
        hits = sum(a for a, d in zip(alarms, some, strict=True) if d.fault != "none")
        right = sum(f == d.fault for f, d in zip(found, some, strict=True) if d.fault != "none")
        print(f"  {name:20s}{false:17d}{hits:15d}{right:12d}{fitting:8.1f}{each:12.2f}", flush=True)
    detector = fit([training], recipe, checked)
    for name, rival in alone(detector, training, checked).items():
        false, hits = (sum(rival(d.log) for d in group) for group in (healthy, faulty))
        print(f"  {name:20s}{false:17d}{hits:15d}{'-':>12s}", flush=True)


if __name__ == "__main__":
    main()
