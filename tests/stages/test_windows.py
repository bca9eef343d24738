"""Windows: whole, without gaps, and the same however the log is cut."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ingest.errors import LogError
from stages.windows import Windows

WINDOWS = Windows(length=10, hop=10, dt=0.1)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.integers(1, 40), min_size=1, max_size=8),
    st.sets(st.integers(0, 200), max_size=4),
    st.integers(1, 10),
)
def test_windows_are_whole_and_do_not_depend_on_the_blocks(
    sizes: list[int], missing: set[int], hop: int
) -> None:
    moving = Windows(length=10, hop=hop, dt=0.1)
    time = np.arange(sum(sizes), dtype=np.float64) * 0.1
    values = np.arange(time.size, dtype=float)[:, None]
    values[[m for m in missing if m < time.size]] = np.nan
    _, whole = moving.cut(moving.start(1), time, values)
    rest, parts = moving.start(1), []
    for end, size in zip(np.cumsum(sizes), sizes, strict=True):
        rest, found = moving.cut(rest, time[end - size : end], values[end - size : end])
        parts += found
    assert len(parts) == len(whole) == _expected(np.isfinite(values[:, 0]), hop)
    for (end, window), (other_end, other) in zip(parts, whole, strict=True):
        assert end == other_end
        np.testing.assert_array_equal(window, other)
        assert window.shape == (10, 1)
        assert (np.diff(window[:, 0]) == 1.0).all()
        assert end == pytest.approx(0.1 * (window[-1, 0] + 1))


def _expected(known: NDArray[np.bool_], hop: int) -> int:
    """Windows of 10 in all stretches of known samples."""
    stretches = np.diff(np.flatnonzero(np.diff(known, prepend=False, append=False)))[::2]
    return int(sum(max(0, (n - 10) // hop + 1) for n in stretches))


def test_a_gap_starts_a_new_window() -> None:
    time = np.delete(np.arange(40, dtype=np.float64) * 0.1, slice(12, 17))
    _, found = WINDOWS.cut(WINDOWS.start(1), time, time[:, None])
    assert [round(end, 6) for end, _ in found] == [1.0, 2.7, 3.7]


def test_another_rate_is_told() -> None:
    time = np.arange(40, dtype=np.float64) * 0.05
    with pytest.raises(LogError, match=r"0.05 s apart, the recipe expects 0.1 s; set its rate_hz"):
        WINDOWS.cut(WINDOWS.start(1), time, time[:, None])
