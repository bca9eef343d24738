"""A made-up run with everything a timeline shows: two residuals, eight regimes, a fault, a gap."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from numpy.typing import NDArray

from ingest.log import Event, Group, Log, Signal
from stages.results import About, Diagnosis, Magnitude, Model, OperatingMap, Verdict

ONSET, DETECTED, DURATION = 200.0, 206.0, 600.0
GAP = (430.0, 444.0)
FAULTS = ("maf_gain", "boost_pressure_gain", "intake_pressure_gain", "boost_leak", "intake_leak")
UNITS = {
    "n_Eng": "rpm",
    "p_Bst": "kPa",
    "p_Int": "kPa",
    "p_Amb": "kPa",
    "T_Int": "K",
    "W_HFM": "g/s",
    "u_Vnt": "%",
}

ABOUT = About(
    models=(Model(name="f_Cyl", output="W_Cyl", inputs=("p_Int", "n_Eng"), unit="g/s", regions=8, rms=0.28),),
    residuals={"r_cyl": "ln(W_Cyl / f_Cyl)", "r_dp": "p_Bst - p_Int - f_dp"},
    training=("wltc, 0 to 1800 s",),
)

Array = NDArray[np.float64]


def _speed(time: Array, rng: np.random.Generator) -> Array:
    """Engine speed in rpm of a drive of hills and stops."""
    steps = rng.uniform(900.0, 3600.0, size=int(DURATION / 12.0) + 2)
    steps[::7] = 800.0
    held = steps[(time / 12.0).astype(int)]
    kernel = np.hanning(int(5.0 / (time[1] - time[0])))
    return np.convolve(held, kernel / kernel.sum(), mode="same")


def drive(duration: float = DURATION, seed: int = 1) -> Log:
    """A log of seven signals at 50 Hz and text at 1 Hz, with a gap, an injected leak and remarks."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, duration, 0.02)
    n = _speed(time, rng)
    load = np.clip(0.5 + 0.4 * np.sin(time / 17.0) * np.sin(time / 5.3), 0.02, 1.0)
    p_int = 101.0 + 95.0 * load * (n / 3600.0) ** 0.7
    values = {
        "n_Eng": n,
        "p_Bst": p_int + 3.0 + 4.0 * load,
        "p_Int": p_int,
        "p_Amb": np.full(time.size, 101.0),
        "T_Int": 300.0 + 20.0 * load,
        "W_HFM": n * p_int * 2.4e-4,
        "u_Vnt": 100.0 * load,
    }
    noise = {"n_Eng": 4.0, "p_Amb": 0.01, "W_HFM": 0.7}
    frame = pl.DataFrame(
        {"time": time, **{k: v + noise.get(k, 0.3) * rng.normal(size=time.size) for k, v in values.items()}}
    ).filter(~pl.col("time").is_between(*GAP))
    signals = {
        k: Signal(name=k, unit=u, flags=("unit assumed",) if k == "u_Vnt" else ()) for k, u in UNITS.items()
    }
    slow = np.arange(0.0, duration, 1.0)
    mode = pl.DataFrame({"time": slow, "control_mode": np.where(slow % 100 < 60, "closed loop", "open loop")})
    events = (
        Event(t_start=ONSET, kind="boost_leak", source="truth", magnitude=4.0, unit="mm"),
        Event(t_start=GAP[0], t_end=GAP[1], kind="gap", source="quality"),
        Event(t_start=71.0, t_end=71.1, kind="spike", channel="p_Bst", source="quality"),
    )
    groups = {"fast": Group("fast", frame, signals), "ecu": Group("ecu", mode)}
    facts = {"file": "drive_07.mf4", "format": "MDF 4.10", "sha256": "9c1f" * 16, "vehicle": "bench 2"}
    return Log(name="drive_07", groups=groups, events=events, facts=facts)


def lattice_edges(rows: int, columns: int) -> NDArray[np.int64]:
    """Neighbours of a rectangular lattice counted row by row."""
    index = np.arange(rows * columns).reshape(rows, columns)
    across = np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()], axis=1)
    down = np.stack([index[:-1].ravel(), index[1:].ravel()], axis=1)
    return np.concatenate([across, down])


def diagnose(log: Log, seed: int = 2) -> Diagnosis:
    """What a run might find in :func:`drive`, at 10 Hz."""
    rng = np.random.default_rng(seed)
    frame = log.groups["fast"].frame.gather_every(5)
    time, n, p = (frame[c].to_numpy() for c in ("time", "n_Eng", "p_Int"))
    nodes = np.array([(1000.0 + 800.0 * i, 112.0 + 45.0 * j + 10.0 * i) for j in range(2) for i in range(4)])
    scaled = (np.stack([n, p], axis=1)[:, None] - nodes) / (800.0, 45.0)
    distance = np.linalg.norm(scaled, axis=2)
    regime = distance.argmin(axis=1)
    faulty = time >= ONSET
    ramp = np.clip((time - ONSET) / 5.0, 0.0, 1.0) * faulty
    samples: dict[str, object] = {
        "time": time,
        "regime": regime.astype(np.int32),
        "in_domain": distance.min(axis=1) < 0.9,
    }
    for r, (base, shift) in {"r_cyl": (0.012, -3.6), "r_dp": (0.8, -5.5)}.items():
        sigma = base * (1.0 + 0.5 * (regime % 3))
        size = 0.6 + 0.6 * np.clip((n - 800.0) / 2000.0, 0.0, 1.0)
        noise = np.convolve(rng.normal(size=time.size + 4), [0.2, 0.5, 0.7, 0.5, 0.2], mode="valid")[
            : time.size
        ]
        value = sigma * (noise + shift * ramp * size)
        samples |= {f"residual.{r}": value, f"sigma.{r}": sigma, f"z.{r}": value / sigma}
    detection = time >= DETECTED
    llr = np.cumsum(np.where(faulty, 0.05, -0.002)) + rng.normal(size=time.size) * 0.5
    share = dict(zip(FAULTS, (-0.4, 0.3, -0.9, 1.0, 0.72), strict=True))
    evidence = np.stack([llr * share[f] for f in FAULTS], axis=1)
    weight = np.exp(np.clip(evidence - evidence.max(axis=1, keepdims=True), -50.0, 0.0))
    p_fault = weight / weight.sum(axis=1, keepdims=True) * detection[:, None]
    samples |= {"detection": detection.astype(np.int8)}
    samples |= {f"evidence.{f}": evidence[:, i].astype(np.float32) for i, f in enumerate(FAULTS)}
    samples |= {f"p.{f}": p_fault[:, i].astype(np.float32) for i, f in enumerate(FAULTS)}
    samples |= {"p.unknown": np.zeros(time.size, dtype=np.float32)}
    verdict = Verdict(
        log=log.name,
        recipe="diesel_airpath",
        detector="3f9a12c0",
        fault="boost_leak",
        set=("boost_leak", "intake_leak"),
        probability={"boost_leak": 0.931, "intake_leak": 0.064, "boost_pressure_gain": 0.005},
        onset_s=201.3,
        detected_s=DETECTED,
        magnitude=Magnitude(value=3.8, sd=0.31, unit="mm"),
        events=(Event(t_start=201.3, kind="boost_leak", source="dynoscope", confidence=0.93),),
        quality={"usable_s": 561.2, "gaps": 1},
    )
    plane = OperatingMap(
        x_label="n_Eng [rpm]",
        y_label="p_Int [kPa]",
        x=n,
        y=p,
        nodes=nodes,
        edges=lattice_edges(2, 4),
        visits=np.array([900.0, 2200.0, 1500.0, 300.0, 150.0, 800.0, 1900.0, 1100.0]),
        spread=np.array([0.8, 1.0, 1.3, 1.6, 1.1, 0.9, 1.0, 1.4]),
    )
    return Diagnosis(
        log=log,
        samples=pl.DataFrame(samples),
        verdict=verdict,
        units={"r_cyl": "1", "r_dp": "kPa"},
        about=ABOUT,
        operating_map=plane,
    )


@pytest.fixture(scope="session")
def log() -> Log:
    return drive()


@pytest.fixture(scope="session")
def diagnosis(log: Log) -> Diagnosis:
    return diagnose(log)
