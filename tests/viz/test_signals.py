from __future__ import annotations

import polars as pl

from ingest.log import Group, Log, Signal
from viz.signals import _of_one_size, _plots


def log_of(units: dict[str, str | None], sizes: dict[str, float] | None = None) -> Log:
    sizes = sizes or {}
    frame = pl.DataFrame({"time": [0.0, 1.0], **{n: [0.0, sizes.get(n, 1.0)] for n in units}})
    return Log(
        name="l", groups={"g": Group("g", frame, {n: Signal(name=n, unit=u) for n, u in units.items()})}
    )


def test_signals_share_a_plot_only_with_their_unit_family_and_size() -> None:
    units = {
        "p_Int": "kPa",
        "n_Eng": "rpm",
        "truth.p_Int": "kPa",
        "p_Bst": "kPa",
        "n_Turb": "rpm",
        "a": None,
        "b": None,
    }
    log = log_of(units, {"n_Eng": 4e3, "n_Turb": 1.4e5})
    assert _plots(log) == [["p_Int", "p_Bst"], ["n_Eng"], ["n_Turb"], ["a"], ["b"], ["truth.p_Int"]]


def test_no_plot_holds_more_series_than_can_be_told_apart() -> None:
    plots = _of_one_size({f"s{i}": 1.0 + i for i in range(9)} | {"x": 0.01})
    assert [len(p) for p in plots] == [8, 1, 1]


def test_text_and_bytes_are_in_no_plot() -> None:
    frame = pl.DataFrame({"time": [0.0], "v": [1], "mode": ["on"], "ok": [True], "blob": [b"x"]})
    assert _plots(Log(name="l", groups={"g": Group("g", frame)})) == [["v"]]
