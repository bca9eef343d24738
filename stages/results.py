"""What a diagnosis is: one table of samples, one verdict, and the map of operating regimes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Self

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.log import Event, Group, Log

# columns of the samples; those with a dot are prefixes of a fault's name
DETECTION, EVIDENCE, PROBABILITY, UNKNOWN = "detection", "evidence.", "p.", "unknown"
PAIR, OF = "+", "."  # between the names of two faults; between a pair and one of its two
STATISTIC, SIZE, SIZE_SD, DETECTABLE = "statistic", "size.", "size_sd.", "detectable."
SENSOR = "sensor."  # of a fault that several sensors can have, and one of them: how evident it is
EXPECTED, EXPECTED_SD = "expected.", "expected_sd."  # of a sensor, what the others say that it should read


@dataclass(frozen=True, kw_only=True)
class Magnitude:
    """Estimated size of a fault: relative (``"1"``), hole diameter (``"mm"``) or opening (``"%"``)."""

    value: float
    sd: float | None
    unit: str


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The diagnosis of one log in a few words; what does not apply is None or empty.

    ``fault`` is ``none`` or ``insufficient_evidence`` without an alarm, else the most probable hypothesis of
    the strongest event, or ``unknown``. ``set`` holds all faults with a probability above 0.05. The sizes of
    two faults at once are ``statistics["magnitudes"]``.
    """

    log: str
    recipe: str
    detector: str | None
    fault: str
    signal: str | None = None
    set: tuple[str, ...] = ()
    probability: Mapping[str, float] = field(default_factory=dict)
    onset_s: float | None = None
    detected_s: float | None = None
    magnitude: Magnitude | None = None
    detectable: Mapping[str, float | None] | None = None
    events: tuple[Event, ...] = ()
    quality: Mapping[str, Any] = field(default_factory=dict)
    statistics: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values, keys as listed in the documentation of ``verdict.json``."""
        return {**asdict(self), "set": list(self.set), "events": [e.to_json() for e in self.events]}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """The inverse of :meth:`to_json`.

        >>> one = Verdict(log="a", recipe="r", detector=None, fault="none", set=("none",))
        >>> Verdict.from_json(one.to_json()) == one
        True
        """
        size = values["magnitude"]
        found = {
            "set": tuple(values["set"]),
            "events": tuple(Event(**event) for event in values["events"]),
            "magnitude": size and Magnitude(**size),
        }
        return cls(**{**values, **found})


@dataclass(frozen=True, kw_only=True, eq=False)
class OperatingMap:
    """Where the system was and which regions it knows, in the plane of two signals.

    ``x, y``: one point per row of the samples, shape (rows,). ``nodes``: region centres, shape (M, 2).
    ``edges``: pairs of neighbouring regions on the self-organising map, shape (E, 2). ``visits``: training
    samples per region; ``spread``: root mean square training residual per region; both shape (M,).
    """

    x_label: str
    y_label: str
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    nodes: NDArray[np.float64]
    edges: NDArray[np.int64]
    visits: NDArray[np.float64]
    spread: NDArray[np.float64]

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values of all but the points; NaN is null."""
        arrays: dict[str, NDArray[Any]] = {
            k: getattr(self, k).astype(object) for k in ("nodes", "edges", "visits", "spread")
        }
        return {"x_label": self.x_label, "y_label": self.y_label} | {
            k: np.where(a == a, a, np.array(None)).tolist()
            for k, a in arrays.items()  # NaN is not itself
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any], x: NDArray[np.float64], y: NDArray[np.float64]) -> Self:
        """The inverse of :meth:`to_json`, with the points."""
        shape: dict[str, tuple[int, ...]] = {"nodes": (-1, 2), "visits": (-1,), "spread": (-1,)}
        arrays = {k: np.array(values[k], dtype=float).reshape(shape[k]) for k in shape}
        edges = np.array(values["edges"], dtype=np.int64).reshape(-1, 2)
        return cls(x_label=values["x_label"], y_label=values["y_label"], x=x, y=y, edges=edges, **arrays)


@dataclass(frozen=True, kw_only=True)
class Model:
    """One relation that a detector uses: ``output`` as a function of ``inputs``.

    ``regions``: of its local models, None where it is a single one; ``rms``: root mean square error on the
    training logs, in ``unit``; ``selected``: whether the inputs were selected by the data, else the recipe
    says them.
    """

    name: str
    output: str
    inputs: tuple[str, ...]
    unit: str = ""
    regions: int | None = None
    rms: float | None = None
    selected: bool = False


RESIDUAL_EDGES = np.linspace(-4.0, 4.0, 41)
"""Of the bins of :attr:`Chosen.residual`, in standard deviations."""


@dataclass(frozen=True, kw_only=True)
class Chosen:
    """What an input selection for ``output`` was decided on.

    ``correlation``: of the K ``candidates`` and, last, the output, (K + 1, K + 1); ``genes``: the best genes
    as numbers of their candidates, best first, with their ``scores`` by ``criterion``; ``history``: the best
    score after each generation, start or evaluation; ``proven``: no gene is better. ``residual``: density by
    bin of :data:`RESIDUAL_EDGES` of what a model of the best gene leaves, and ``spectrum``: its power at
    frequencies from 0 (left out) to a half per sample, white being 1 throughout.
    """

    name: str
    output: str
    criterion: str
    proven: bool
    candidates: tuple[str, ...]
    correlation: tuple[tuple[float, ...], ...]
    genes: tuple[tuple[int, ...], ...]
    scores: tuple[float, ...]
    history: tuple[float, ...]
    residual: tuple[float, ...]
    spectrum: tuple[float, ...]

    @property
    def taken(self) -> tuple[str, ...]:
        """The selected candidates."""
        return tuple(self.candidates[i] for i in self.genes[0])

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """The inverse of ``dataclasses.asdict``, from lists."""
        lists: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        nested = {k: tuple(tuple(row) for row in values[k]) for k in ("correlation", "genes")}
        return cls(**{**lists, **nested})


@dataclass(frozen=True, kw_only=True)
class About:
    """What a detector is made of: its models, what their inputs were selected on, each residual's formula,
    the logs it learned from."""

    models: tuple[Model, ...] = ()
    selections: tuple[Chosen, ...] = ()
    residuals: Mapping[str, str] = field(default_factory=dict)
    training: tuple[str, ...] = ()
    calibration: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """
        >>> one = About(models=(Model(name="f", output="y", inputs=("u",)),), residuals={"r": "y - f"})
        >>> About.from_json(one.to_json()) == one
        True
        """
        return asdict(self)

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """The inverse of :meth:`to_json`."""
        models = tuple(Model(**{**m, "inputs": tuple(m["inputs"])}) for m in values["models"])
        lists = {k: tuple(values[k]) for k in ("training", "calibration", "notes")}
        selections = tuple(Chosen.from_json(c) for c in values.get("selections", ()))
        return cls(models=models, selections=selections, residuals=dict(values["residuals"]), **lists)


@dataclass(frozen=True, kw_only=True, eq=False)
class Diagnosis:
    """All that a run knows about one log.

    ``samples`` has one row per sample of the analysis raster: ``time``, ``regime``, ``in_domain``, per
    residual ``residual.<r> sigma.<r> z.<r>``, ``detection``, per hypothesis ``evidence.<f>`` and ``p.<f>``.
    For a monitor's windows ``indicator.<i>`` stands in place of the residuals. ``units`` gives the unit of
    each. ``signals``: the monitored signals at their own rate, with what a healthy sensor would have read.
    ``about``: what the detector is made of.
    """

    log: Log
    samples: pl.DataFrame
    verdict: Verdict
    units: Mapping[str, str] = field(default_factory=dict)
    operating_map: OperatingMap | None = None
    signals: Group | None = None
    about: About | None = None
