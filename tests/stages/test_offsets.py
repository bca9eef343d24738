"""Offsets drawn anew for every log are found again; noise alone is none."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from scipy.signal import lfilter

from ingest.log import Group, Log
from stages.offsets import LEAST_WANDER, correlation_times, offset_sd, shape_sd, wander_sd
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


@pytest.mark.parametrize(("phi", "tau"), [(0.0, 1.0), (0.6, 2.0), (0.8, 4.5), (0.99, 10.0)])
def test_the_correlation_time_of_a_first_order_process(phi: float, tau: float) -> None:
    """Its errors add up as if each half second were ``(1 + phi) / (1 - phi)`` of them; held within 1 to
    10."""
    rng, t = np.random.default_rng(5), np.arange(0, 3000, 0.5)

    def log(i: int) -> Log:
        z = lfilter([np.sqrt(1 - phi**2)], [1, -phi], rng.normal(size=t.size))
        frame = pl.DataFrame({"time": t, "residual.r": 3 + 2 * z, "sigma.r": np.full(t.size, 2.0)})
        return Log(f"log{i}", {ANALYSIS: Group(ANALYSIS, frame)})

    assert correlation_times([log(i) for i in range(8)], ["r"], 1.0)[0] == pytest.approx(tau, rel=0.15)
    assert correlation_times([log(0)], ["r"], 2.0)[0] == 2.0


def test_how_much_of_a_shape_logs_hold_is_found_again() -> None:
    rng, t = np.random.default_rng(6), np.arange(0, 1000, 0.5)
    h = np.maximum(np.sin(t / 50), 0.0)

    def log(i: int) -> Log:
        e = rng.normal(0, 0.4) * h + rng.normal(0, 0.5, t.size)
        frame = pl.DataFrame({"time": t, "residual.r": e, "sigma.r": np.full(t.size, 0.5)})
        return Log(f"log{i}", {ANALYSIS: Group(ANALYSIS, frame)})

    logs, shape = [log(i) for i in range(60)], [h[:, None]] * 60
    assert shape_sd(logs, ["r"], shape, np.zeros(1), 0.5)[0] == pytest.approx(0.4, rel=0.3)
    assert shape_sd(logs[:1], ["r"], shape[:1], np.array([0.1]), 0.5)[0] == 0.1
    assert shape_sd(logs, ["r"], [0 * x for x in shape], np.array([0.1]), 0.5)[0] == 0.0


def test_how_far_offsets_wander_within_a_log_is_found_again() -> None:
    """They change every 100 s; what all of a log has is none of it, and noise alone neither."""
    rng, t = np.random.default_rng(7), np.arange(0, 4000, 0.5)

    def log(i: int, sd: float) -> Log:
        e = rng.normal(0, 2.0) + rng.normal(0, sd, 40).repeat(200) + rng.normal(0, 0.5, t.size)
        frame = pl.DataFrame({"time": t, "residual.r": e, "sigma.r": np.full(t.size, 0.5)})
        return Log(f"log{i}", {ANALYSIS: Group(ANALYSIS, frame)})

    lasting = np.array([0.5])
    wandering, steady = ([log(i, sd) for i in range(10)] for sd in (0.3, 0.0))
    assert wander_sd(wandering, ["r"], np.zeros(1), 100.0, lasting)[0] == pytest.approx(0.3, rel=0.1)
    assert wander_sd(steady, ["r"], np.zeros(1), 100.0, lasting)[0] < 0.02
    assert wander_sd(steady, ["r"], np.array([2.0]), 100.0, lasting)[0] == pytest.approx(
        2 * LEAST_WANDER, 0.01
    )
    assert wander_sd(steady[:2], ["r"], np.array([2.0]), 100.0, lasting)[0] == np.inf
