"""Made-up vehicles: two residuals in six regions, two kinds of wear, three faults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ingest.errors import RecipeError
from stages.adapt import Seen, Settings, State, Wear, commission, follow
from stages.forget import forgotten
from stages.poison import Drives

Array = NDArray[np.float64]
R, M, F, BEGIN, N = 2, 6, 3, 20, 120
WEARS = [
    Wear(residuals={"a": "-1"}, per_100=0.05, total=0.15),
    Wear(residuals={"b": "1"}, per_100=0.2, total=0.6),
]
SHAPES = np.random.default_rng(9).normal(size=(F, R, M)) * 0.02
WEAR_SHAPES = np.stack(
    [np.stack([-np.ones(M), np.zeros(M)]), np.stack([np.zeros(M), 0.2 + 0.1 * np.arange(M)])]
)


def vehicle(
    seed: int, wear: tuple[float, float] = (0.0, 0.0), fault: int = 0, size: Array | float = 0.0,
    shapes: Array = SHAPES,
) -> tuple[Drives, Array]:  # fmt: skip
    """Wear grows to ``wear`` in 100 drives from BEGIN on; the fault has ``size`` at each drive."""
    rng = np.random.default_rng(seed)
    count = rng.integers(5, 60, size=(N, R, M)).astype(float)
    noise = np.hypot(0.001, 0.005 / np.sqrt(count)) * rng.normal(size=(N, R, M))
    mean = 0.002 * rng.normal(size=(N, R, 1)) + noise + 0.01 * rng.normal(size=(1, R, M))
    grown = np.clip((np.arange(N) - BEGIN) / 100, 0, None)
    for level, shape in zip(wear, WEAR_SHAPES, strict=True):
        mean += (level * grown)[:, None, None] * shape
    mean += np.broadcast_to(size, N)[:, None, None] * shapes[fault]
    shift = np.repeat(shapes[None], N, axis=0)
    drives = Drives(mean=mean, count=count, shift=shift, noise=np.full(R, 0.005), offset=np.full(R, 0.002))
    return drives, np.repeat(WEAR_SHAPES[None], N, axis=0)


def watched(drives: Drives, shift: Array, settings: Settings | None = None) -> tuple[State, list[Seen]]:
    every = np.arange(N)
    state = commission(drives.but(every[:BEGIN]), shift[:BEGIN], WEARS)
    return follow(state, drives.but(every[BEGIN:]), shift[BEGIN:], WEARS, settings or Settings())


def ramp(over: int, size: float) -> Array:
    return np.clip((np.arange(N) - 30) / over, 0.0, 1.0) * size


@pytest.mark.parametrize("wear", [(0.0, 0.0), (0.05, 0.0), (0.0, 0.2), (0.05, 0.2)])
def test_wear_is_followed_without_an_alarm(wear: tuple[float, float]) -> None:
    alarms, off = 0, []
    for seed in range(8):
        _, seen = watched(*vehicle(seed, wear))
        alarms += any(s.alarm for s in seen)
        off.append(np.abs(np.array(seen[-1].wear) - wear) / [0.05, 0.2])
    assert alarms == 0
    assert np.median(off) < 0.1


def test_a_reference_that_is_off_is_no_wear() -> None:
    """The mean of the commissioning is off by two of its own standard deviations, as wear would be from the
    first drive on; what wears begins at nothing."""
    found = []
    for seed in range(12):
        drives, shift = vehicle(seed)
        mean = drives.mean.copy()
        mean[:BEGIN, 0] += 0.0009
        found.append(watched(replace(drives, mean=mean), shift)[1][-1].wear[0])
    assert np.median(found) < 1.2 * 0.0009  # 1.5 times where it is not allowed for


@pytest.mark.parametrize("over", [1, 20, 80])
def test_a_fault_is_told_and_not_learned(over: int) -> None:
    for seed in range(4):
        _, seen = watched(*vehicle(seed, fault=1, size=ramp(over, 2.0)))
        first = next(i for i, s in enumerate(seen) if s.alarm)
        assert 10 <= first < 10 + max(over, 3)
        assert 1 in seen[-1].faults
        assert seen[-1].alarm  # it does not get used to it
        assert not seen[-1].learned
        assert max(abs(w) for w in seen[-1].wear) < 0.03


def test_wear_beyond_its_budget_is_an_alarm() -> None:
    """Where a fault looks like it."""
    shapes = np.concatenate([SHAPES[:2], WEAR_SHAPES[:1] * 0.02])
    _, seen = watched(*vehicle(1, (0.4, 0.0), shapes=shapes))
    assert any(s.alarm for s in seen)
    assert all(s.wear[0] <= 0.15 for s in seen)


def test_what_cannot_be_told_from_wear_is_shown_beside_it() -> None:
    """A fault with the signature of wear, at the speed of wear."""
    shapes = np.concatenate([SHAPES[:2], WEAR_SHAPES[:1] * 0.02])
    _, seen = watched(*vehicle(2, fault=2, size=ramp(90, 2.0), shapes=shapes))
    assert not any(s.alarm for s in seen)
    assert 2 in seen[-1].faults
    assert seen[-1].wear[0] == pytest.approx(0.04, abs=0.01)
    _, of_other = watched(*vehicle(2, (0.0, 0.2), shapes=shapes))
    assert 2 not in of_other[-1].faults


def test_learning_rests_and_goes_on() -> None:
    size = np.zeros(N)
    size[50:60] = 2.0
    _, seen = watched(*vehicle(3, (0.05, 0.0), fault=0, size=size), Settings(memory=4))
    rests = [not s.learned for s in seen]
    assert all(rests[31:40])
    assert not any(rests[-20:])
    assert seen[-1].wear[0] == pytest.approx(0.05, rel=0.2)


def test_what_begins_in_one_drive_is_not_learned_from_it() -> None:
    """A fault like wear, there in one drive only: ten drives together have little evidence of it."""
    shapes = np.concatenate([SHAPES[:2], WEAR_SHAPES[:1] * 0.02])
    for size, learned in ((0.0, True), (2.0, False)):
        _, seen = watched(*vehicle(6, fault=2, size=np.where(np.arange(N) == 60, size, 0.0), shapes=shapes))
        assert seen[60 - BEGIN].learned == learned
        assert not seen[60 - BEGIN].alarm
        assert all(s.learned for s in seen[62 - BEGIN :])


def test_new_regions_join_only_without_evidence() -> None:
    drives, shift = vehicle(4)
    count = drives.count.copy()
    count[:BEGIN, :, 4:] = 0.0
    quiet, _ = watched(replace(drives, count=count), shift)
    assert (quiet.reference.seen[:, 4:] > 0).all()
    faulty, _ = vehicle(4, fault=1, size=np.where(np.arange(N) >= BEGIN, 4.0, 0.0))
    state, seen = watched(replace(faulty, count=count), shift)
    assert seen[5].alarm
    assert (state.reference.seen[:, 4:] == 0).all()


def test_bounds_are_checked() -> None:
    with pytest.raises(RecipeError, match="positive bounds"):
        Wear(residuals={"a": "1"}, per_100=0.0, total=1.0)


def test_forgetting_learns_a_slow_fault_completely() -> None:
    """Which is why it is not what `adapt` does."""
    drives, _ = vehicle(5, fault=1, size=ramp(20, 2.0))
    taken = forgotten(drives.mean, drives.count, 0.9)
    left, there = (np.abs(x[-20:] - drives.mean[:BEGIN].mean(axis=0)).mean() for x in (
        drives.mean - taken + drives.mean[:BEGIN].mean(axis=0), drives.mean))  # fmt: skip
    assert left < 0.25 * there
    with pytest.raises(RecipeError, match="above 0, at most 1"):
        forgotten(drives.mean, drives.count, 0.0)
