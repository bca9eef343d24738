"""What the input selection does where nothing is promised: few rows, coloured noise, outliers, four inputs,
collinear and constant candidates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.selection_cases import Case, chosen, examples, show, system_case, systems
from benchmarks.systems import SYSTEMS, System
from stages.genes import Space, Structure
from stages.selecting import Search, select

Array = NDArray[np.float64]


def _four(y: Array, u: Array, t: int) -> float:
    mixed = np.tanh(2 * u[t - 2, 0]) * u[t - 4, 1]
    return float(0.4 * y[t - 1] + mixed + 0.5 * u[t - 1, 2] ** 2 + 0.5 * abs(u[t - 6, 3]))


FOUR_INPUTS = System(
    name="four inputs", f=_four, sd=0.05, na=1, nb=(1, 1, 1, 1), nk=(2, 4, 1, 6)
)  # of 1.6 million genes, which are not walked


def run(seeds: Sequence[int]) -> None:
    """Exact hits of ``seeds``; nothing is demanded."""
    for n in (500, 300):
        hits: dict[str, int] = {}
        for seed in seeds:
            for case in (*examples(n, seed), *systems(n, seed)):
                hits[case.name] = hits.get(case.name, 0) + chosen(case, Search())[0]
        _show(f"N = {n}", hits, len(seeds))
    for word, noise in (("coloured noise, AR(1) 0.7", _coloured), ("1 % outliers of 10 sd", _outliers)):
        hits = {
            s.name: sum(chosen(system_case(s, 4000, seed, noise), Search())[0] for seed in seeds)
            for s in SYSTEMS
        }
        _show(word, hits, len(seeds))
    results = [chosen(system_case(FOUR_INPUTS, 4000, s), Search()) for s in seeds]
    median = float(np.median([t for _, t in results]))
    show(
        9,
        f"four inputs, N = 4000: exact, of {len(seeds)}",
        f"{sum(h for h, _ in results)}, median {median:.2f} s",
    )
    for share in (0.3, 0.1, 0.03):
        hits = {}
        for seed in seeds:
            for case in (*examples(2000, seed), *systems(2000, seed)):
                hit = chosen(_with(case, _shadow(case, share, seed)), Search())[0]
                hits[case.name] = hits.get(case.name, 0) + hit
        _show(f"N = 2000, a candidate that is u1 and {share:.0%} noise", hits, len(seeds))
    _left_out(seeds)


def _left_out(seeds: Sequence[int]) -> None:
    """Candidates that say nothing new are named and left out, and the rest is found."""
    extras: dict[str, Callable[[Array], Array]] = {
        "u1 - 2 u2": lambda z: z[:, -3] - 2 * z[:, -2],
        "constant": lambda z: np.full(len(z), 3.0),
    }
    for word, extra in extras.items():
        right = 0
        for seed in seeds:
            *_, case = examples(2000, seed)
            wide = _with(case, extra(case.z))
            found = select([wide.z], wide.names, wide.output, wide.space)
            right += found.structure == wide.truth and any("extra is left out" in n for n in found.notes)
        show(9, f"Example 2, N = 2000, a candidate that is {word}: left out, of {len(seeds)}", str(right))


def _with(case: Case, extra: Array) -> Case:
    """The case with one candidate more, which is not in the true structure."""
    names = (*case.names, "extra")
    outputs = case.space.outputs
    inputs = (*case.space.inputs, "extra")
    space = Space.of(outputs, inputs, na_max=3, nb_max=3, nk_max=7)
    truth = Structure(case.truth.na, {**case.truth.nb, "extra": 0}, {**case.truth.nk, "extra": 0})
    return replace(case, z=np.column_stack([case.z, extra]), names=names, space=space, truth=truth)


def _shadow(case: Case, share: float, seed: int) -> Array:
    """u1 with noise of that share of its variance."""
    u = case.z[:, list(case.names).index("u1")]
    noise = np.random.default_rng([seed, 5]).normal(size=len(u)) * u.std()
    return np.asarray(np.sqrt(1 - share) * u + np.sqrt(share) * noise)


def _coloured(rng: np.random.Generator, n: int) -> Array:
    e = rng.standard_normal(n)
    for t in range(1, n):
        e[t] = 0.7 * e[t - 1] + np.sqrt(1 - 0.49) * e[t]
    return e


def _outliers(rng: np.random.Generator, n: int) -> Array:
    return rng.standard_normal(n) * np.where(rng.random(n) < 0.01, 10.0, 1.0)


def _show(word: str, hits: dict[str, int], count: int) -> None:
    show(9, f"{word}: exact, of {count}", ", ".join(f"{k} {v}" for k, v in hits.items()))
