from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.poison import LEAST, THRESHOLD, Drives, suspicious

R, M, F = 2, 6, 3


def drives(
    rng: np.random.Generator, N: int, poisoned: dict[int, tuple[int, float]], offset: float = 0.002
) -> Drives:
    """Drives by the model of the module's text; ``poisoned``: fault and size by drive."""
    count = rng.integers(0, 60, size=(N, R, M)).astype(float)
    direction = np.random.default_rng(99).normal(size=(F, R, M)) * 0.01
    shift = np.repeat(direction[None], N, axis=0) * (1 + 0.1 * rng.normal(size=(N, 1, 1, 1)))
    mean = 0.01 * rng.normal(size=(1, R, M)) + offset * rng.normal(size=(N, R, 1))
    mean = (
        mean
        + 0.001 * rng.normal(size=(N, R, M))
        + 0.005 / np.sqrt(np.maximum(count, 1)) * rng.normal(size=(N, R, M))
    )
    for k, (f, x) in poisoned.items():
        mean[k] += x * shift[k, f]
    return Drives(mean=mean, count=count, shift=shift, noise=np.full(R, 0.005), offset=np.full(R, 0.002))


@settings(max_examples=30)
@given(st.integers(0, 10_000), st.integers(0, 6), st.integers(0, F - 1))
def test_up_to_30_percent_are_found_and_named(seed: int, count: int, fault: int) -> None:
    rng = np.random.default_rng(seed)
    which = {int(k): (fault, 2.0) for k in rng.choice(20, count, replace=False)}
    found = suspicious(drives(rng, 20, which))
    by_chance = [s for s in found if s.drive not in which]  # 2 in 32 000 clean drives, both just above
    assert len(by_chance) <= 1
    assert all(s.T < 2 * THRESHOLD and s.size < 0.5 for s in by_chance)
    found = [s for s in found if s not in by_chance]
    assert {s.drive for s in found} == set(which)
    assert {s.fault for s in found} <= {fault}
    assert all(s.size == pytest.approx(2.0, rel=0.3) for s in found)
    assert [s.T for s in found] == sorted((s.T for s in found), reverse=True)


def test_clean_sets_are_left_alone() -> None:
    named = sum(len(suspicious(drives(np.random.default_rng(s), 20, {}))) for s in range(40))
    assert named <= 4  # of 800


def test_a_fault_that_hides_in_the_tolerance_is_not_found() -> None:
    """A sensor's gain that shifts all regions alike, as its tolerance does."""
    clean = drives(np.random.default_rng(1), 20, {}, offset=0.02)
    clean.shift[:] = 0.02
    clean.mean[3] += clean.shift[3, 0]
    assert not suspicious(clean)
    clean.mean[3] += 9 * clean.shift[3, 0]
    assert suspicious(clean)[0].drive == 3


def test_a_third_with_one_fault_is_not_taken_for_tolerance() -> None:
    """A sensor's gain at 8 standard deviations of its tolerance, in 6 of 20: among all drives it is 2. One
    of them that is let in, as those of the last three seeds, must not let in the others."""
    for seed in (*range(8), 10, 33, 46):
        logs = drives(np.random.default_rng(seed), 20, {}, offset=0.006)
        logs.shift[:, 0] = 0.0
        logs.shift[:, 0, 0] = 0.035
        logs.mean[:6] += 1.4 * logs.shift[:6, 0]
        found = {s.drive for s in suspicious(logs)}
        assert found <= {*range(6)}
        assert len(found) >= (6 if seed < 8 else 5)


def test_a_tiny_size_is_a_tolerance_however_certain() -> None:
    clean = drives(np.random.default_rng(5), 20, {})
    clean.noise[:], clean.count[:] = 1e-4, 100.0
    clean.mean[:] = 1e-5 * np.random.default_rng(5).normal(size=clean.mean.shape)
    clean.mean[3] += 0.4 * clean.shift[3, 1]
    assert not suspicious(clean)
    clean.mean[3] += 0.4 * clean.shift[3, 1]
    assert [s.drive for s in suspicious(clean)] == [3]


def test_a_healthy_drive_elsewhere_is_not_suspicious() -> None:
    """It was in regions that no other has visited."""
    rng = np.random.default_rng(2)
    all_drives = drives(rng, 12, {})
    all_drives.count[:, :, 3:] = 0.0
    all_drives.count[0, :, :3], all_drives.count[0, :, 3:] = 0.0, 50.0
    all_drives.mean[0, :, 3:] += 1.0
    assert not suspicious(all_drives)


def test_of_a_few_drives_nothing_can_be_said() -> None:
    rng = np.random.default_rng(3)
    assert suspicious(drives(rng, LEAST - 1, {0: (1, 50.0)})) == []
    assert [s.drive for s in suspicious(drives(rng, LEAST + 1, {0: (1, 5.0)}))] == [0]


def test_the_same_logs_give_the_same_answer() -> None:
    one = suspicious(drives(np.random.default_rng(4), 20, {1: (0, 2.0), 7: (2, 2.0)}))
    assert one == suspicious(drives(np.random.default_rng(4), 20, {1: (0, 2.0), 7: (2, 2.0)}))
