"""Selecting: from the recorded variables to the regressors of one output, by any of the searches.

The default rule, ``evidence`` (:mod:`stages.descent`), compares genes by models of their own. The searches
``exhaustive``, ``genetic`` and ``coordinate`` minimise a criterion (:mod:`stages.criteria`) on one partition
of the space of all candidates (:mod:`stages.partition`), as in Fig. 4.1; only the exhaustive one proves its
optimum.

Variables that cannot be told apart from others are left out first: constant ones, and those that are a linear
combination of the variables before them at the same time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ingest.errors import LogError, RecipeError
from stages.coordinate import coordinate
from stages.criteria import CRITERIA, Criterion, score_of
from stages.descent import descend
from stages.exhaustive import exhaustive
from stages.genes import Space, Structure
from stages.genetic import Genetic, genetic
from stages.gram import Gram, gather
from stages.lags import Lagged
from stages.partition import Growth, grow
from stages.search import Found

Array = NDArray[np.float64]
Method = Literal["evidence", "exhaustive", "genetic", "coordinate"]
EVIDENCE = "evidence"
SAME = 1e-10  # share of a variable's variance that others leave unexplained: none
ROWS_PER_CANDIDATE = 3
LOOKED_AT = 50_000  # rows
MOST_LAG = 60  # to which automatic bounds may grow
GROWTH = {"na_max": 1, "nb_max": 1, "nk_max": 4}


@dataclass(frozen=True, kw_only=True)
class Search:
    """How to search. The rule ``evidence`` looks at ``rows`` rows drawn at random (``seed``); the others at
    all rows, in at most ``regions`` regions with ``samples_per_parameter`` rows per parameter each (S1-S3 of
    4.2.2), from a map grown on ``rows`` rows. ``auto``: bounds grow until the optimum lies inside.

    Raises:
        RecipeError: an unknown criterion, one that does not go with the search, or a number out of range.
    """

    search: Method = "evidence"
    criterion: str = ""
    rows: int = 6000
    regions: int = 16
    samples_per_parameter: float = 2.0
    max_error: float = 0.0
    restarts: int = 3
    genetic: Genetic = field(default_factory=Genetic)
    auto: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        known = (EVIDENCE, *CRITERIA)
        if self.criterion and self.criterion not in known:
            raise RecipeError(f"criterion {self.criterion!r} is not known; known: {', '.join(known)}")
        if self.criterion and (self.criterion == EVIDENCE) != (self.search == EVIDENCE):
            raise RecipeError(
                f"criterion {self.criterion!r} does not go with search {self.search!r}; the rule 'evidence' "
                f"has its own, the other searches one of {', '.join(CRITERIA)}"
            )
        if self.rows < 100 or self.regions < 1 or self.restarts < 0 or self.seed < 0:
            raise RecipeError(
                f"search: needs rows >= 100, regions >= 1, restarts >= 0, seed >= 0; got rows = {self.rows}, "
                f"regions = {self.regions}, restarts = {self.restarts}, seed = {self.seed}"
            )


@dataclass(frozen=True, eq=False)
class Selection:
    """What was selected: ``structure`` over all variables asked for, excluded ones unused; ``found`` in
    ``space``; ``notes`` for the user."""

    structure: Structure
    space: Space
    found: Found
    criterion: str
    rows: int
    regions: int
    notes: tuple[str, ...]


def select(
    segments: Sequence[Array],
    names: Sequence[str],
    output: str,
    space: Space,
    search: Search | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Selection:
    """Select the regressors of ``output`` from ``space``.

    ``segments``: stretches without gaps, shape (N, len(names)), columns ``names``.

    Raises:
        LogError: the output is constant, or there are too few complete windows.
        RecipeError: no candidate is left, or the space is too large for the search.
    """
    with threadpool_limits(1, user_api="blas"):  # small problems: threads would only wait for each other
        return _select(segments, names, output, space, search or Search(), progress)


def _select(
    segments: Sequence[Array],
    names: Sequence[str],
    output: str,
    space: Space,
    search: Search,
    progress: Callable[[str], None],
) -> Selection:
    asked, notes = space, []
    values = _some(segments, len(names))
    _check_output(values, names, output)
    if unusable := _unusable(values, names, space, output):
        notes += [f"{name} is left out: {why}" for name, why in unusable.items()]
        space = _without(space, unusable)
    while True:
        found, criterion, rows, regions = _search(segments, names, output, space, search)
        touched = space.on_bound(found.gene)
        if not (touched and search.auto) or (larger := _grown(space, touched)) == space:
            break
        space = larger
        progress(f"{output}: the optimum lies on a bound; searching {space.size} genes")
    for kind, name, bound in touched:
        if not _only_choice(space, name):
            notes.append(
                f"the best gene lies on the bound {kind} = {bound} of {name}; raise it, or let it grow"
            )
    chosen = space.structure(found.gene)
    whole = Structure(
        {n: chosen.na.get(n, 0) for n in asked.outputs},
        {n: chosen.nb.get(n, 0) for n in asked.inputs},
        {n: chosen.nk.get(n, 0) for n in asked.inputs},
    )
    return Selection(whole, space, found, criterion, rows, regions, tuple(notes))


def lagged_rows(segments: Sequence[Array], names: Sequence[str], output: str, space: Space) -> Lagged:
    """The rows (candidates of ``space`` | output)."""
    place = {n: i for i, n in enumerate(names)}
    variable = np.array([place[n] for n, _ in space.candidates], dtype=np.int64)
    lag = np.array([k for _, k in space.candidates], dtype=np.int64)
    contiguous = [np.ascontiguousarray(s, dtype=np.float64) for s in segments]
    return Lagged(contiguous, variable, lag, place[output])


def common_partition(sample: Array, search: Search) -> tuple[Array, Array, Array]:
    """Centre and scale (K + 1,) of rows (candidates | output), and the nodes (M, K) of a map of the scaled
    candidates."""
    centre, scale = sample.mean(axis=0), sample.std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    S = (sample - centre) / scale
    growth = Growth(
        nodes=search.regions, samples_per_parameter=search.samples_per_parameter,
        max_error=search.max_error / scale[-1], rows=search.rows,
    )  # fmt: skip
    return centre, scale, grow(S[:, :-1], S[:, -1], np.ones(len(S)), growth).nodes


def _search(
    segments: Sequence[Array], names: Sequence[str], output: str, space: Space, search: Search
) -> tuple[Found, str, int, int]:
    """What was found, by which criterion, from how many rows and regions."""
    lagged = lagged_rows(segments, names, output, space)
    K = len(space.candidates)
    if lagged.rows < ROWS_PER_CANDIDATE * (K + 1):
        raise LogError(
            f"{output}: {lagged.rows} complete windows of {lagged.reach + 1} samples are too few for {K} "
            f"candidates, at least {ROWS_PER_CANDIDATE * (K + 1)} are needed; take longer or more logs, or "
            "lower the bounds"
        )
    sample = lagged.sample(search.rows, search.seed)
    if search.search == EVIDENCE:
        scale = sample.std(axis=0)
        standard = (sample - sample.mean(axis=0)) / np.where(scale > 0, scale, 1.0)
        scorer = descend(space, standard)
        history = list(np.minimum.accumulate(list(scorer.scores.values())))
        found = Found.from_scores(scorer.scores, history, size=0)
        model = scorer.models[found.gene]
        return found, EVIDENCE, len(sample), model.M if model else 1
    centre, scale, nodes = common_partition(sample, search)
    gram = gather(lagged, centre, scale, nodes)
    criterion = search.criterion or "pooled"
    found = _on_partition(space, gram, criterion, float(scale[-1]), search)
    return found, criterion, lagged.rows, len(nodes)


def _on_partition(space: Space, gram: Gram, criterion: str, scale: float, search: Search) -> Found:
    score = score_of(cast(Criterion, criterion), gram, scale)
    if search.search == "exhaustive":
        return exhaustive(space, gram, score)

    def of(gene: int) -> float:
        return score.of(gram, space.columns(gene))

    if search.search == "genetic":
        return genetic(space, of, search.genetic, seed=search.seed)
    return coordinate(space, of, restarts=search.restarts, seed=search.seed)


def _some(segments: Sequence[Array], width: int) -> Array:
    """Rows to look at the variables themselves: every n-th."""
    step = max(1, sum(len(s) for s in segments) // LOOKED_AT)
    return np.concatenate([np.empty((0, width)), *(s[::step] for s in segments)])


def _check_output(values: Array, names: Sequence[str], output: str) -> None:
    y = values[:, list(names).index(output)]
    if not len(y):
        raise LogError(f"{output}: there is no sample at which {', '.join(names)} all have a value")
    if y.std() <= SAME * max(abs(y).max(), 1e-300):
        raise LogError(f"{output}: it is constant, at {y[0]:g}; nothing explains a constant")


def _unusable(values: Array, names: Sequence[str], space: Space, output: str) -> dict[str, str]:
    """Variables that cannot be used, and why, in words."""
    order = [*space.outputs, *space.inputs]
    columns = values[:, [list(names).index(n) for n in order]]
    spread = columns.std(axis=0)
    out: dict[str, str] = {}
    kept: list[int] = []
    for i, name in enumerate(order):
        if spread[i] <= 1e-12 * max(np.abs(columns[:, i]).max(initial=0.0), 1e-300):
            out[name] = f"it is constant, at {columns[0, i]:g}"
            continue
        z = (columns[:, i] - columns[:, i].mean()) / spread[i]
        if kept:
            A = (columns[:, kept] - columns[:, kept].mean(axis=0)) / spread[kept]
            theta = np.linalg.lstsq(A.T @ A, A.T @ z, rcond=None)[0]
            if np.mean((z - A @ theta) ** 2) < SAME:
                used = [order[k] for k, b in zip(kept, theta, strict=True) if abs(b) > 1e-4]
                out[name] = f"it is a linear combination of {', '.join(used)}"
                continue
        kept.append(i)
    out.pop(output, None)  # the other outputs at the same time may explain it: its past is still its own
    return out


def _without(space: Space, unusable: dict[str, str]) -> Space:
    if needed := sorted(set(space.fixed) & set(unusable)):
        raise LogError(f"{needed[0]} is fixed as a regressor, but {unusable[needed[0]]}")
    past = [(n, a) for n, a in zip(space.outputs, space.na_max, strict=True) if n not in unusable]
    exogenous = [
        e for e in zip(space.inputs, space.nb_max, space.nk_max, strict=True) if e[0] not in unusable
    ]
    try:
        return Space(
            tuple(n for n, _ in past), tuple(n for n, _, _ in exogenous),
            tuple(a for _, a in past), tuple(b for _, b, _ in exogenous), tuple(k for _, _, k in exogenous),
            space.fixed,
        )  # fmt: skip
    except RecipeError:
        reasons = "; ".join(f"{n}: {why}" for n, why in unusable.items())
        raise LogError(f"no usable candidate is left ({reasons})") from None


def _only_choice(space: Space, name: str) -> bool:
    """Whether a variable is a column that is taken or not, so that its bound says nothing."""
    block = next(b for b in space.blocks if b.name == name)
    return block.chains * block.length == 1 and name in space.inputs


def _grown(space: Space, touched: Sequence[tuple[str, str, int]]) -> Space:
    """The bounds that were touched, raised."""
    for kind, name, bound in touched:
        names = space.outputs if kind == "na_max" else space.inputs
        if bound + GROWTH[kind] <= MOST_LAG and not _only_choice(space, name):
            bounds = list(getattr(space, kind))
            bounds[names.index(name)] += GROWTH[kind]
            space = replace(space, **{kind: tuple(bounds)})
    return space
