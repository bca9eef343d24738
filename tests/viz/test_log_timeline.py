"""What is in the recording of a log without a run: names, times, units, envelopes of long groups."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from recordings import drawn_lines, frames, lane, signal, titles, verify

from ingest.errors import LogError
from ingest.log import Event, Group, Log, Signal
from viz import signals
from viz.send import VALUES
from viz.timeline import write_log_timeline


def one(frame: dict[str, Any], **log: Any) -> Log:
    return Log(name="l", groups={"g": Group("g", pl.DataFrame(frame))}, **log)


@pytest.mark.parametrize("odd", ["", "/", "a b", "**", "+ /x", "ü°C", "a.b[0]", "\\", "x:y", "-"])
def test_any_name_can_be_shown(odd: str, tmp_path: Path) -> None:
    group = Group(odd, pl.DataFrame({"time": [0.0, 1.0], odd + "v": [1.0, 2.0], odd + "s": ["on", "off"]}))
    path = tmp_path / "odd.rrd"
    write_log_timeline(Log(name=odd, groups={odd: group}), path)
    assert verify(path) == 0
    (drawn,) = drawn_lines(path)
    assert drawn[1] == odd + "v"
    (values,) = (f["value"].to_list() for k, f in frames(path).items() if k.endswith(VALUES))
    assert values == [[{drawn[0]: 1.0}], [{drawn[0]: 2.0}]]


def test_rows_out_of_order_are_shown_in_order(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    order = rng.permutation(500)
    write_log_timeline(one({"time": order * 0.1, "v": order * 1.0}), tmp_path / "l.rrd")
    time, values = signal(frames(tmp_path / "l.rrd"), "g", "v")
    assert values.ravel().tolist() == list(range(500))
    assert time == pytest.approx(np.arange(500) * 0.1)


def test_long_groups_keep_their_peaks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signals, "BYTES", 60_000)
    monkeypatch.setattr(signals, "ENVELOPE_POINTS", 1000)
    monkeypatch.setattr(signals, "FEWEST", 500)
    values = np.sin(np.arange(20_000) / 50.0)
    values[12_345] = 99.0
    write_log_timeline(one({"time": np.arange(20_000) * 1e-3, "v": values}), tmp_path / "l.rrd")
    found = frames(tmp_path / "l.rrd")
    _, drawn = signal(found, "g", "v")
    assert drawn.size <= 1002
    assert (drawn.max(), drawn.min()) == (99.0, values.min())
    assert "least and greatest" in found["/summary TextDocument:text"]["value"][0][0]


def test_long_groups_keep_every_value_where_it_matters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signals, "BYTES", 60_000)
    monkeypatch.setattr(signals, "FEWEST", 500)
    rng = np.random.default_rng(5)
    values = rng.normal(size=20_000)
    events = (Event(t_start=7.0, kind="sensor_offset", source="truth"),)
    write_log_timeline(
        one({"time": np.arange(20_000) * 1e-3, "v": values}, events=events), tmp_path / "l.rrd"
    )
    found = frames(tmp_path / "l.rrd")
    time, drawn = signal(found, "g", "v")
    near = np.abs(time - 7.0) < 0.2995
    assert drawn[near].ravel().tolist() == values[6701:7300].tolist()
    assert (np.diff(time) >= 0).all()
    assert (drawn.max(), drawn.min()) == (values.max(), values.min())
    assert drawn.size * (signals.ROW_BYTES + 8) < 1.1 * 60_000
    assert "every value from 6." in found["/summary TextDocument:text"]["value"][0][0]


def test_what_cannot_be_drawn_is_named(tmp_path: Path) -> None:
    write_log_timeline(one({"time": [0.0], "v": [1], "blob": [b"x"]}), tmp_path / "l.rrd")
    text = frames(tmp_path / "l.rrd")["/summary TextDocument:text"]["value"][0][0]
    assert "blob: neither number nor text" in text


def test_events_may_reach_beyond_the_log(tmp_path: Path) -> None:
    events = tuple(
        Event(t_start=a, t_end=b, kind=k, source="truth")
        for a, b, k in ((-5.0, 3.0, "maf_gain"), (2.0, 99.0, "boost_leak"))
    )
    write_log_timeline(one({"time": np.arange(11.0), "v": np.zeros(11)}, events=events), tmp_path / "l.rrd")
    states = lane(frames(tmp_path / "l.rrd"), "/fault_injected")
    assert states == [(0.0, "maf_gain"), (2.0, "boost_leak+maf_gain"), (3.0, "boost_leak"), (10.0, "")]


Write = Callable[[Path], None]


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda p: write_log_timeline(one({"time": [0.0]}), p / "no" / "l.rrd"), "there is no folder"),
        (lambda p: write_log_timeline(one({"time": [1e12, 2e12]}), p / "l.rrd"), "expected seconds"),
        (lambda p: write_log_timeline(Log(name="l", groups={}), p / "l.rrd"), "no samples"),
    ],
)
def test_mistakes_are_explained_and_leave_nothing(write: Write, message: str, tmp_path: Path) -> None:
    with pytest.raises(LogError, match=message):
        write(tmp_path)
    assert not list(tmp_path.iterdir())


def test_units_stand_with_their_signals(tmp_path: Path) -> None:
    frame = pl.DataFrame({"time": [0.0, 1.0], "a": [1.0, 2.0], "b": [1.0, 2.0], "c": [1.0, 2.0]})
    given = {
        "a": Signal(name="a", unit="kPa"),
        "b": Signal(name="b", unit="K"),
        "c": Signal(name="c", unit="kPa"),
    }
    write_log_timeline(Log(name="l", groups={"g": Group("g", frame, given)}), tmp_path / "l.rrd")
    assert sorted(title for title in titles(tmp_path / "l.rrd") if "[" in title) == ["a, c [kPa]", "b [K]"]


def test_plots_of_one_signal_share_the_rows_of_their_group(tmp_path: Path) -> None:
    """24 bytes of time and id come with a row; 14 signals of 8 bytes that share it stay near 9 each."""
    rng = np.random.default_rng(7)
    rows, count = 20_000, 14
    values = {f"s{i}": rng.normal(size=rows) for i in range(count)}
    for kind, limit in ((np.float64, 9.1), (np.float32, 5.2)):
        frame = {"time": np.arange(rows) * 0.02, **{n: v.astype(kind) for n, v in values.items()}}
        write_log_timeline(one(frame), tmp_path / "whole.rrd")
        write_log_timeline(one({n: v[:2] for n, v in frame.items()}), tmp_path / "layout.rrd")
        whole, layout = ((tmp_path / f"{n}.rrd").stat().st_size for n in ("whole", "layout"))
        assert (whole - layout) / rows / count < limit
        found = frames(tmp_path / "whole.rrd")
        assert all((signal(found, "g", n)[1] == v.astype(kind)).all() for n, v in values.items())
