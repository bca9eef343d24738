"""Ten million rows: the streaming pass against the BLAS floor, memory, and the structure."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.selection_cases import Case, examples, show
from stages.criteria import score_of
from stages.exhaustive import exhaustive
from stages.gram import ROWS, gather
from stages.lags import Lagged
from stages.selecting import Search, common_partition, select
from stages.tree import nested_centres

REGIONS = 16


def run(seeds: Sequence[int]) -> None:
    """Part 5."""
    for n in (1_000_000, 3_000_000, 10_000_000):
        hits = 0
        for i, seed in enumerate(seeds if n > 1_000_000 else seeds[:1]):
            case = next(c for c in examples(n, seed, na_max=7) if c.name == "y")
            hit = _one(case, n, first=i == 0)
            hits += hit
        show(5, f"{n:.0e} rows: right structure", f"{hits} of {i + 1}", "all", hits == i + 1)


def _one(case: Case, n: int, first: bool) -> bool:
    """Whether the structure is right; the first of a size is timed."""
    Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here
    before, clock = _memory_mb("VmRSS"), time.process_time()
    selection = select([case.z], case.names, case.output, case.space, Search())
    chosen = time.process_time()
    _final_fit(case, list(selection.structure.regressors))
    done = time.process_time()
    lagged = case.lagged()
    centre, scale, nodes = common_partition(lagged.sample(20_000), Search(regions=REGIONS, rows=20_000))
    mapped = time.process_time()
    gram = gather(lagged, centre, scale, nodes)
    passed = time.process_time()
    found = exhaustive(case.space, gram, score_of("pooled", gram))
    searched = time.process_time()
    if first:
        floor = _floor(len(nodes), gram.G.shape[0] + 1) * n
        ratio = (passed - mapped) / floor
        show(
            5, f"{n:.0e} rows, {len(case.space.candidates)} candidates: pass over BLAS floor",
            f"{ratio:.2f} ({passed - mapped:.2f} s, {n / (passed - mapped) / 1e6:.1f} Mrows/s)",
            "<= 2", ratio <= 2,
        )  # fmt: skip
        total = searched - clock
        show(
            5, f"{n:.0e} rows: everything, {len(nodes)} regions",
            f"{total:.2f} s: rule {chosen - clock:.2f}, final fit {done - chosen:.2f}, "
            f"map {mapped - done:.2f}, pass {passed - mapped:.2f}, search {searched - passed:.2f}",
            "< 6 s", total < 6,
        )  # fmt: skip
        added = _memory_mb("VmHWM") - before
        show(5, f"{n:.0e} rows: memory over the data", f"{added:.0f} MB", "< 150 MB", added < 150)
        same = case.space.structure(found.gene) == case.truth
        show(
            5,
            f"{n:.0e} rows: the proven optimum of the table on all rows",
            "true" if same else "not the true one",
        )
    return selection.structure == case.truth


def _final_fit(case: Case, regressors: list[tuple[str, int]]) -> None:
    """Local models in the selected inputs from one pass over all rows."""
    place = {n: i for i, n in enumerate(case.names)}
    variable, lag = (
        np.array(x, dtype=np.int64) for x in zip(*((place[n], k) for n, k in regressors), strict=True)
    )
    lagged = Lagged([np.ascontiguousarray(case.z)], variable, lag, place[case.output])
    sample = lagged.sample(20_000)
    centre, scale = sample.mean(axis=0), sample.std(axis=0)
    nodes = nested_centres(((sample - centre) / scale)[:, :-1], int(np.log2(REGIONS)))[-1]
    gather(lagged, centre, scale, nodes).rss(range(len(regressors)))


def _floor(regions: int, columns: int) -> float:
    """Seconds per row of the Gram matrix and of the distances to the nodes, on a block in the cache."""
    rng = np.random.default_rng(0)
    block, nodes = rng.normal(size=(4 * ROWS, columns)), rng.normal(size=(columns - 2, regions))
    best = np.inf
    for _ in range(20):
        began = time.process_time()
        block.T @ block
        block[:, :-2] @ nodes
        best = min(best, time.process_time() - began)
    return best / len(block)


def _memory_mb(kind: str) -> float:
    """Resident now (VmRSS) or at most so far (VmHWM)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(kind)) / 1024
