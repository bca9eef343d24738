"""Offsets drawn anew for every log are found again; noise alone is none."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from ingest.log import Group, Log
from stages.offsets import offset_sd
from stages.stage import ANALYSIS


def logs(count: int, sd: float, noise: float = 0.5) -> list[Log]:
    rng = np.random.default_rng(3)
    t = np.arange(0, 1000, 0.5)
    return [
        Log(
            f"log{i}",
            {
                ANALYSIS: Group(
                    ANALYSIS,
                    pl.DataFrame(
                        {
                            "time": t,
                            "residual.r": rng.normal(0, sd) + rng.normal(0, noise, t.size),
                            "sigma.r": np.full(t.size, noise),
                        }
                    ),
                )
            },
        )
        for i in range(count)
    ]


def test_offsets_are_found_again() -> None:
    found = offset_sd(logs(60, 0.4), ["r"], np.zeros(1), 100.0, 0.5)
    assert found[0] == pytest.approx(0.4, rel=0.3)


def test_noise_is_no_offset_and_what_is_supposed_counts_as_one_log() -> None:
    assert offset_sd(logs(20, 0.0), ["r"], np.zeros(1), 100.0, 0.5)[0] < 0.03
    assert offset_sd(logs(3, 0.0), ["r"], np.array([1.0]), 100.0, 0.5)[0] == pytest.approx(0.5, rel=0.05)


def test_few_logs_tell_nothing() -> None:
    assert offset_sd(logs(2, 5.0), ["r"], np.array([0.1]), 100.0, 0.5)[0] == 0.1
