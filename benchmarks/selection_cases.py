"""What the benchmark of the input selection runs on, and how it prints."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.systems import SYSTEMS, Noise, System
from ingest.simulators.examples import STRUCTURES, example1, example2
from stages.genes import Space, Structure
from stages.lags import Lagged
from stages.selecting import Search, lagged_rows, select

Array = NDArray[np.float64]
NOISE = {"y1": 0.1, "y2": 0.2, "y": 0.05}  # standard deviations of (4.16) and (4.19)


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """Data (N, variables) of an output with known structure; ``noise``: its standard deviation."""

    name: str
    z: Array
    names: Sequence[str]
    output: str
    space: Space
    truth: Structure
    noise: float

    def lagged(self) -> Lagged:
        return lagged_rows([self.z], self.names, self.output, self.space)

    def regressors(self) -> tuple[Array, Array]:
        """The true regressors (rows, k) and the output."""
        rows = self.lagged().sample(10**9)
        return rows[:, list(self.space.columns(self.space.find(self.truth)))], rows[:, -1]


def examples(n: int, seed: int, na_max: int = 3) -> Iterator[Case]:
    """Example 1 (y1, y2) and Example 2 (y)."""
    for system, make, p in (("example1", example1, 2), ("example2", example2, 1)):
        data = make(n, 1.0, seed)
        names = list(data)
        space = Space.of(names[:p], names[p:], na_max=na_max, nb_max=3, nk_max=7)
        for output, s in STRUCTURES[system].items():
            z = np.column_stack(list(data.values()))
            yield Case(
                name=output, z=z, names=names, output=output, space=space, truth=Structure(**s),
                noise=NOISE[output],
            )  # fmt: skip


def systems(n: int, seed: int) -> Iterator[Case]:
    """The strongly nonlinear systems."""
    for system in SYSTEMS:
        yield system_case(system, n, seed)


def system_case(system: System, n: int, seed: int, noise: Noise | None = None) -> Case:
    data = system.simulate(n, seed, noise)
    names = list(data)
    space = Space.of(["y"], names[1:], na_max=3, nb_max=3, nk_max=7)
    return Case(
        name=system.name, z=np.column_stack(list(data.values())), names=names, output="y", space=space,
        truth=system.structure, noise=system.sd,
    )  # fmt: skip


def chosen(case: Case, search: Search) -> tuple[bool, float]:
    """Whether the true structure was selected, and the CPU seconds it took."""
    began = time.process_time()
    selection = select([case.z], case.names, case.output, case.space, search)
    return selection.structure == case.truth, time.process_time() - began


def show(part: int, what: str, measured: str, target: str = "", holds: bool | None = None) -> None:
    """One line of the table."""
    word = {True: "holds", False: "MISSED", None: ""}[holds]
    print(f"{part}  {what:<58s} {measured:<46s} {target:<22s} {word}".rstrip(), flush=True)
