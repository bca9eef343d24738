from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from ingest.errors import LogError, RecipeError
from ingest.log import Group, Log
from stages.normalise import Normalise
from stages.stage import ANALYSIS, columns, transform


def block(**values: list[float | None]) -> Log:
    n = len(next(iter(values.values())))
    return Log(
        "x", {ANALYSIS: Group(ANALYSIS, pl.DataFrame({"time": [float(i) for i in range(n)], **values}))}
    )


def test_min_max_of_all_training_logs() -> None:
    stage = Normalise(columns=("a",)).fit([block(a=[2.0, 4.0]), block(a=[None, 10.0])])
    scaled = columns(transform([stage], block(a=[2.0, 6.0, 12.0, None])))["a.norm"]
    np.testing.assert_allclose(scaled, [0.0, 0.5, 1.25, np.nan])


def test_a_tail_leaves_spikes_out() -> None:
    x: list[float | None] = [*np.linspace(0, 1, 1001).tolist(), 1e6]
    stage = Normalise(columns=("a",), tail=0.01).fit([block(a=x)])
    assert stage.learned["hi"][0] < 1


def test_constant_and_missing_columns_are_named() -> None:
    with pytest.raises(LogError, match="'a' is constant"):
        Normalise(columns=("a",)).fit([block(a=[1.0, 1.0])])
    with pytest.raises(LogError, match="'a' is missing"):
        Normalise(columns=("a",)).fit([block(a=[None, None])])
    with pytest.raises(RecipeError, match=r"tail = 0.5"):
        Normalise(columns=("a",), tail=0.5)
