"""Others' methods on the same data in the same run: structure selection, and partitions."""

from __future__ import annotations

import importlib
import time
import warnings
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.selection_cases import Case, examples, show
from benchmarks.selection_models import Fit, Predict, Scores, cases, curved, linear, map_blended, map_hard
from stages.partition import Growth, grow
from stages.selecting import Search, select

Array = NDArray[np.float64]
Chosen = set[tuple[str, int]]  # variables and lags
NOTHING = 0.05  # of the output's spread: coefficients below are none


def run(seeds: Sequence[int]) -> None:
    """Part 7."""
    warnings.simplefilter("ignore")
    _structures(seeds)
    _partitions(seeds[:3])
    _map_against_kmeans(seeds[:3])


def _structures(seeds: Sequence[int]) -> None:
    ways: dict[str, Callable[[Case], Chosen]] = {
        "dynoscope, the rule": _rule,
        "SysIdentPy FROLS, degree 2, BIC": _frols,
        "PySINDy STLSQ, quadratic": _sindy,
        "scikit-learn SFS, linear": _sequential,
        "LassoLarsIC BIC, linear": lambda case: _lasso(case, quadratic=False),
        "LassoLarsIC BIC, quadratic": lambda case: _lasso(case, quadratic=True),
        "mutual information, true count given": _mutual,
    }
    for way, method in ways.items():
        hits: dict[str, int] = {}
        seconds: list[float] = []
        try:
            for seed in seeds:
                for case in examples(4000, seed):
                    began = time.process_time()
                    chosen = method(case)
                    seconds.append(time.process_time() - began)
                    exact = chosen == {*case.truth.regressors}
                    hits[case.name] = hits.get(case.name, 0) + exact
        except ImportError as error:
            show(7, way, f"not here: {error}")
            continue
        text = ", ".join(f"{k} {v}" for k, v in hits.items())
        show(7, f"{way}: exact, of {len(seeds)}", f"{text}; median {np.median(seconds):.2f} s")


def _rule(case: Case) -> Chosen:
    return {*select([case.z], case.names, case.output, case.space, Search()).structure.regressors}


def _rows(case: Case) -> tuple[Array, Array]:
    """Standardised candidates, and the output less its mean."""
    rows = case.lagged().sample(10**9)
    X, y = rows[:, :-1], rows[:, -1]
    return (X - X.mean(axis=0)) / X.std(axis=0), y - y.mean()


def _frols(case: Case) -> Chosen:
    """Its candidates are those of the bounds, without u(t)."""
    basis = importlib.import_module("sysidentpy.basis_function")
    building = importlib.import_module("sysidentpy.model_structure_selection")
    inputs = [i for i, n in enumerate(case.names) if n != case.output]
    lags = [
        [*range(1, 4)] if case.names[i] in case.space.outputs else [*range(1, 10)] for i in inputs
    ]  # fmt: skip
    model = building.FROLS(
        order_selection=True, n_info_values=20, ylag=[1, 2, 3], xlag=lags, info_criteria="bic",
        basis_function=basis.Polynomial(degree=2),
    )  # fmt: skip
    y = case.z[:, [list(case.names).index(case.output)]]
    model.fit(X=case.z[:, inputs], y=y)
    chosen: Chosen = set()
    for term in model.final_model:
        for code in term:
            if code:
                variable, lag = divmod(int(code), 1000)
                name = case.output if variable == 1 else case.names[inputs[variable - 2]]
                chosen.add((name, lag))
    return chosen


def _sindy(case: Case) -> Chosen:
    sindy = importlib.import_module("pysindy")
    X, y = _rows(case)
    library = sindy.PolynomialLibrary(degree=2).fit(X)
    features = np.asarray(library.transform(X))
    optimizer = sindy.STLSQ(threshold=NOTHING * float(y.std()))
    optimizer.fit(features, y[:, None])
    return _of_terms(case, np.asarray(library.powers_), np.abs(optimizer.coef_.ravel()) > 0)


def _of_terms(case: Case, powers: Array, used: NDArray[np.bool_]) -> Chosen:
    columns = np.flatnonzero((powers[used] > 0).any(axis=0))
    return {case.space.candidates[c] for c in columns}


def _sequential(case: Case) -> Chosen:
    selection = importlib.import_module("sklearn.feature_selection")
    model = importlib.import_module("sklearn.linear_model")
    X, y = _rows(case)
    found = selection.SequentialFeatureSelector(model.LinearRegression(), tol=1e-3).fit(X, y)
    return {case.space.candidates[c] for c in np.flatnonzero(found.get_support())}


def _lasso(case: Case, *, quadratic: bool) -> Chosen:
    model = importlib.import_module("sklearn.linear_model")
    X, y = _rows(case)
    powers = np.eye(X.shape[1])
    if quadratic:
        made = importlib.import_module("sklearn.preprocessing").PolynomialFeatures(2, include_bias=False)
        X = made.fit_transform(X)
        powers = np.asarray(made.powers_)
    found = model.LassoLarsIC(criterion="bic").fit((X - X.mean(axis=0)) / X.std(axis=0), y)
    return _of_terms(case, powers, np.abs(found.coef_) > 0)


def _mutual(case: Case) -> Chosen:
    selection = importlib.import_module("sklearn.feature_selection")
    X, y = _rows(case)
    order = np.argsort(selection.mutual_info_regression(X, y, random_state=0))[::-1]
    return {case.space.candidates[c] for c in order[: len(case.truth.regressors)]}


def _kmeans(X: Array, y: Array, regions: int) -> Predict:
    cluster = importlib.import_module("sklearn.cluster")
    centre, scale = X.mean(axis=0), X.std(axis=0)
    found = cluster.KMeans(regions, n_init=1, random_state=0).fit((X - centre) / scale)
    return _local(X, y, lambda Z: np.asarray(found.predict((Z - centre) / scale)), regions)


def _minisom(X: Array, y: Array, regions: int) -> Predict:
    centre, scale = X.mean(axis=0), X.std(axis=0)
    S = (X - centre) / scale
    som = importlib.import_module("minisom").MiniSom(4, regions // 4, X.shape[1], sigma=1.0, random_seed=0)
    som.train(S, 10 * len(S))
    nodes = som.get_weights().reshape(regions, -1)

    def region(Z: Array) -> NDArray[np.int64]:
        return np.asarray((0.5 * (nodes**2).sum(axis=1) - (Z - centre) / scale @ nodes.T).argmin(axis=1))

    return _local(X, y, region, regions)


def _linear_tree(X: Array, y: Array, _: int) -> Predict:
    model = importlib.import_module("sklearn.linear_model")
    tree = importlib.import_module("lineartree").LinearTreeRegressor(
        model.LinearRegression(), max_depth=5, min_samples_leaf=60
    )
    tree.fit(X, y)
    return lambda Z: np.asarray(tree.predict(Z))


def _local(X: Array, y: Array, region: Callable[[Array], NDArray[np.int64]], regions: int) -> Predict:
    """Least squares in every region; one that nobody visited takes that of all."""
    unit, A = region(X), np.column_stack([np.ones(len(X)), X])
    theta = np.tile(np.linalg.lstsq(A, y, rcond=None)[0], (regions, 1))
    for m in range(regions):
        if (unit == m).sum() > A.shape[1]:
            theta[m] = np.linalg.lstsq(A[unit == m], y[unit == m], rcond=None)[0]
    return lambda Z: np.asarray((np.column_stack([np.ones(len(Z)), Z]) * theta[region(Z)]).sum(axis=1))


def _partitions(seeds: Sequence[int]) -> None:
    ways: dict[str, Fit] = {
        "single linear": linear, "map, hard regions": map_hard, "map, blended": map_blended,
        "curved map, blended (final model)": curved, "KMeans, local least squares": _kmeans,
        "MiniSom, local least squares": _minisom, "linear-model tree": _linear_tree,
    }  # fmt: skip
    for way, fit in ways.items():
        scores: dict[str, Scores] = {}
        try:
            for seed in seeds:
                for case, fresh in cases(5000, seed):
                    scores.setdefault(case.name, Scores()).add(case, fit, fresh, 32)
        except (ImportError, AttributeError) as error:  # linear-tree wants scikit-learn < 1.6
            show(7, way, f"not here: {error}")
            continue
        text = ", ".join(f"{k} {np.mean(s.rms):.3f}" for k, s in scores.items())
        seconds = np.median([t for s in scores.values() for t in s.seconds])
        show(7, f"{way}, 32 regions: RMS over the noise", f"{text}; {seconds:.3f} s")


def _map_against_kmeans(seeds: Sequence[int]) -> None:
    """The growing map's time over KMeans' at as many regions, best of five each."""
    try:
        cluster = importlib.import_module("sklearn.cluster")
    except ImportError as error:
        show(7, "growing the map over KMeans", f"not here: {error}")
        return
    ratios: list[float] = []
    for seed in seeds:
        for case, _ in cases(5000, seed):
            X, y = case.regressors()
            S, one = (X - X.mean(axis=0)) / X.std(axis=0), np.ones(len(y))
            for regions in (16, 32):
                kmeans = cluster.KMeans(regions, n_init=1, random_state=0)
                growth = Growth(nodes=regions)
                grown, clustered = np.inf, np.inf
                for _ in range(5):
                    began = time.process_time()
                    grow(S, y, one, growth)
                    grown = min(grown, time.process_time() - began)
                    began = time.process_time()
                    kmeans.fit(S)
                    clustered = min(clustered, time.process_time() - began)
                ratios.append(grown / clustered)
    mean = float(np.mean(ratios))
    show(
        7, "growing the map, time over KMeans', 16 and 32 regions",
        f"mean {mean:.2f} ({min(ratios):.2f} .. {max(ratios):.2f})", "<= 1.7", mean <= 1.7,
    )  # fmt: skip
