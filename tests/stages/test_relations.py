"""Relations that build on one another, hold only in places, or take other inputs where one is missing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from ingest.errors import LogError
from ingest.log import Group, Log
from stages.normalise import Normalise
from stages.relation import Relation
from stages.relations import Relations
from stages.stage import ANALYSIS, columns, transform

RELATIONS = {
    "f_flow": Relation(output="W", inputs=("p",), weight="1 / (1 + egr ** 4)", nodes=4),
    "f_egr": Relation(output="f_flow - W", inputs=("egr", "p"), otherwise=("egr",), where="egr - 1", nodes=4),
}
NORMALISE = Normalise(columns=("q",), optional=("p", "egr"))


def drive(seed: int, egr: bool = True) -> Log:
    """A flow ``20 + 100 p``, of which an open valve takes ``0.2 egr``; the valve is open half of the time."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 500.0)
    p, opening = rng.uniform(0, 1, t.size), rng.uniform(20, 80, t.size) * (t % 2) * egr
    W = 20 + 100 * p - 0.2 * opening + rng.normal(0, 0.05, t.size)
    return Log(
        "d", {ANALYSIS: Group(ANALYSIS, pl.DataFrame({"time": t, "p": p, "q": p, "egr": opening, "W": W}))}
    )


def fit(log: Log, relations: Mapping[str, Relation] = RELATIONS) -> tuple[Normalise, Relations]:
    ready = NORMALISE.fit([log])
    stage = Relations(relations=relations, regime="f_flow", map=("p", "W"))
    return ready, stage.fit([transform([ready], log)])


def test_a_relation_builds_on_an_earlier_one_and_is_nothing_elsewhere() -> None:
    out = columns(transform(fit(drive(1)), drive(2)))
    shut = out["egr"] < 1
    np.testing.assert_allclose(out["f_flow"], 20 + 100 * out["p"], atol=0.2)  # learned while shut
    np.testing.assert_allclose(out["f_egr"][~shut], 0.2 * out["egr"][~shut], atol=0.5)
    assert (out["f_egr"][shut] == 0).all()
    assert (out["f_egr.sd"][shut] == 0).all()


def test_a_relation_that_never_held_knows_nothing() -> None:
    out = transform(fit(drive(1, egr=False)), drive(2))
    open_ = columns(out)["egr"] > 1
    assert np.isinf(columns(out)["f_egr.novelty"][open_]).all()
    in_domain = out.groups[ANALYSIS].frame["in_domain"].to_numpy()
    assert not in_domain[open_].any()
    assert in_domain[~open_].mean() > 0.98


def test_other_inputs_where_one_is_missing() -> None:
    log = drive(1)
    frame = log.groups[ANALYSIS].frame.with_columns(pl.lit(None, pl.Float64).alias("p"))
    relations = {**RELATIONS, "f_flow": replace(RELATIONS["f_flow"], inputs=("q",))}
    relations["f_egr"] = replace(relations["f_egr"], inputs=("egr", "p"))
    lacking = Log("d", {ANALYSIS: Group(ANALYSIS, frame)})
    stage = Relations(relations=relations, regime="f_flow", map=("q", "W"))
    ready = NORMALISE.fit([lacking])
    fitted = stage.fit([transform([ready], lacking)])
    assert fitted.inputs("f_egr") == ("egr",)
    assert fitted.inputs("f_flow") == ("q",)
    out = columns(transform([ready, fitted], lacking))
    np.testing.assert_allclose(out["f_egr"][out["egr"] > 1], 0.2 * out["egr"][out["egr"] > 1], atol=1.0)


def test_the_regime_must_exist() -> None:
    never = {**RELATIONS, "f_flow": replace(RELATIONS["f_flow"], where="-1")}
    with pytest.raises(LogError, match="which gives the regime, holds nowhere"):
        fit(drive(1), never)
