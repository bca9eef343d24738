from __future__ import annotations

import polars as pl

from viz.evidence import leading


def test_hypotheses_that_were_ever_probable_lead_then_those_with_evidence() -> None:
    samples = pl.DataFrame(
        {
            "p.a": [0.0, 0.0],
            "p.b": [0.0, 0.6],
            "p.c": [0.4, 0.0],
            "p.unknown": [0.0, 0.0],
            "evidence.a": [5.0, float("nan")],
            "evidence.b": [1.0, 1.0],
            "evidence.c": [9.0, 9.0],
            "evidence.d": [99.0, 0.0],
        }
    )
    assert leading(samples) == ["b", "c", "a", "unknown", "d"]


def test_no_rows_have_no_leader() -> None:
    samples = pl.DataFrame(
        {"p.a": [], "evidence.a": []}, schema={"p.a": pl.Float32, "evidence.a": pl.Float32}
    )
    assert leading(samples) == ["a"]
