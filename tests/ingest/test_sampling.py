from __future__ import annotations

import numpy as np
import pytest

from ingest import sampling
from ingest.sampling import Sampling, clock_events, clock_quality


def stamps(seed: int, *, jumps: bool = True) -> sampling.Floats:
    """Fifty thousand of 100 Hz with jitter, gaps, equal ones, and some where the clock goes back."""
    rng = np.random.default_rng(seed)
    step = 0.01 + 0.001 * rng.standard_normal(50_000)
    step[rng.integers(0, len(step), 30)] = rng.uniform(1.0, 9.0, 30)
    step[rng.integers(0, len(step), 40)] = 0.0
    step[rng.integers(0, len(step), 5)] = -0.003
    if jumps:
        step[[9_000, 40_000]] = (-20.0, -7.0)
    return np.cumsum(step)


def added(time: sampling.Floats, size: int) -> Sampling:
    found = Sampling()
    for i in range(0, len(time), size):
        found.add(time[i : i + size])
    return found


@pytest.mark.parametrize("size", [1000, 7001, 10**6])
@pytest.mark.parametrize("seed", [1, 2])
def test_parts_of_few_rows_are_exact(size: int, seed: int) -> None:
    time = stamps(seed)
    assert added(time, size).quality() == clock_quality(time)
    assert added(time, size).events() == clock_events(time)


@pytest.mark.parametrize("size", [333, 4000, 10**6])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_of_many_rows_all_but_percentiles_are_exact(
    size: int, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sampling, "MANY", 5000)
    time = stamps(seed)
    found, exact = added(time, size), clock_quality(time)
    for name in ("rate_hz", "jitter"):
        assert found.quality()[name] == pytest.approx(exact[name], rel=0.08)
    rest = {k: v for k, v in exact.items() if k not in ("rate_hz", "jitter")}
    assert {k: found.quality()[k] for k in rest} == rest
    assert found.events() == clock_events(time)
    assert (found.low, found.high) == (time.min(), time.max())
    assert found.quality() == found.quality()  # asking changes nothing


def test_memory_does_not_grow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampling, "MANY", 1000)
    found = added(stamps(1), 500)
    assert found.folded is not None
    kept = sum(map(len, found.waiting)) + len(found.folded["steps"])
    assert kept < 50_000 / sampling.THINNED + 2000
