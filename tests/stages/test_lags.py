from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.lags import Lagged, segments


def lagged(lengths: list[int]) -> Lagged:
    """Variable 0 counts rows over all segments, variable 1 is its negative."""
    starts = np.cumsum([0, *lengths])
    parts = [
        np.column_stack([np.arange(a, a + n), -np.arange(a, a + n)]).astype(float)
        for a, n in zip(starts, lengths, strict=False)
    ]
    return Lagged(parts, np.array([0, 1, 1]), np.array([1, 0, 3]), 0)


@given(lengths=st.lists(st.integers(0, 9), min_size=1, max_size=5), rows=st.integers(1, 7))
@settings(deadline=None)
def test_windows_never_span_two_segments(lengths: list[int], rows: int) -> None:
    L = lagged(lengths)
    blocks = [b.copy() for b in L.blocks(rows)]
    whole = np.vstack([np.empty((0, 4)), *blocks])
    assert len(whole) == L.rows == sum(max(n - 3, 0) for n in lengths)
    t = whole[:, 3]
    np.testing.assert_array_equal(whole, np.column_stack([t - 1, -t, 3 - t, t]))
    edges = np.cumsum([0, *lengths])
    before = np.searchsorted(edges, t, side="right")
    assert (np.searchsorted(edges, t - 3, side="right") == before).all()
    np.testing.assert_array_equal(L.take(np.arange(L.rows)), whole)


def test_a_sample_is_in_order_without_repetition_and_repeatable() -> None:
    L = lagged([500, 700])
    some = L.sample(100, seed=4)
    assert some.shape == (100, 4)
    assert (np.diff(some[:, 3]) > 0).all()
    np.testing.assert_array_equal(some, L.sample(100, seed=4))
    assert len(L.sample(5000)) == L.rows


def test_segments_end_at_gaps_and_missing_values() -> None:
    time = np.concatenate([np.arange(10.0), np.arange(20.0, 30.0)])
    values = np.arange(20.0)[:, None]
    values[[0, 5, 19]] = np.nan
    assert [s.ravel().tolist() for s in segments(time, values)] == [
        [1, 2, 3, 4], [6, 7, 8, 9], [10, 11, 12, 13, 14, 15, 16, 17, 18],
    ]  # fmt: skip
    assert segments(time, np.full((20, 1), np.nan)) == []
