from __future__ import annotations

import numpy as np
import polars as pl
from hypothesis import given
from hypothesis import strategies as st

from ingest.log import Event, Log
from viz.lanes import MOMENT, diagnosed, held, quality_remarks

times = st.integers(-5, 25).map(float)
events = st.builds(
    lambda start, length, kind: Event(
        t_start=start, t_end=None if length is None else start + length, kind=kind, source="truth"
    ),
    times,
    st.none() | st.integers(1, 10),
    st.sampled_from("abc"),
)


@given(st.lists(events, max_size=6))
def test_what_holds_is_what_the_events_say(given_events: list[Event]) -> None:
    at, names = held(given_events, 0.0, 20.0)
    for t in np.arange(0.25, 20.0, 0.5):
        kinds = {e.kind for e in given_events if e.t_start <= t < (20.0 if e.t_end is None else e.t_end)}
        assert names[int(np.searchsorted(at, t, side="right")) - 1] == "+".join(sorted(kinds))
    assert at[0] == 0.0
    assert at[-1] == 20.0


def test_a_moment_is_wide_enough_to_be_seen() -> None:
    at, names = held([Event(t_start=5.0, t_end=5.0, kind="spike", source="quality")], 0.0, 1000.0)
    i = names.index("spike")
    assert at[i + 1] - at[i] == 1000.0 * MOMENT


def test_the_most_probable_hypothesis_counts_only_in_alarm() -> None:
    samples = pl.DataFrame(
        {
            "detection": [0, 1, 1, 1],
            "p.a": [0.9, 0.2, None, float("nan")],
            "p.b": [0.0, 0.7, 0.1, 0.6],
            "p.unknown": 0.1,
        }
    )
    assert diagnosed(samples).tolist() == ["none", "b", "b", "b"]


def test_an_alarm_without_hypotheses_is_unknown() -> None:
    assert diagnosed(pl.DataFrame({"detection": [0, 1]})).tolist() == ["none", "unknown"]


def test_what_a_simulator_alone_knows_is_not_remarked_on() -> None:
    told = tuple(
        Event(t_start=0.0, kind=kind, channel=channel, source="quality")
        for kind, channel in (("stuck", "truth.W"), ("stuck", "p_Bst"), ("gap", None))
    )
    assert quality_remarks(Log(name="l", groups={}, events=told)) == [*told[1:]]
