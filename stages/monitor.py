"""Monitor: is the sensor changing, or the plant it watches? One row per window, from one input and one
output.

Each window of the analysis group gives indicators with their covariance (:mod:`stages.estimators`): the
sensor's time constant and gain, the plant's gain and coefficients. The gains are known up to std(w_p),
which is taken to be stationary as in (3.14). Healthy is the information-weighted mean over the first
``reference_s`` of usable windows, or over fault-free logs if the stage was fitted. A window is judged by

    z = (indicator - healthy) / sigma, sigma^2 from the window's own covariance and that of the reference,

which, unlike the 3 sigma limits of the dissertation, knows how well each window was excited. The decision is
that of :mod:`stages.deciding`, from moving averages over windows.

What comes out: the rows of the windows as the analysis group, and the signals as they came in group
``signals``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, Self

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.errors import LogError, RecipeError
from ingest.log import TIME, Group, Log, Signal
from stages.deciding import Belief, Decision, probabilities
from stages.estimators import Estimate, EstimatorName, Innovations, Memory, Printed
from stages.residuals import SIGMA, Z
from stages.results import DETECTION, EVIDENCE, PROBABILITY, SIZE, SIZE_SD, UNKNOWN
from stages.stage import ANALYSIS, Arrays, Stage, columns
from stages.structure import Structure
from stages.templates import Template
from stages.tracking import Reference
from stages.two_rate import TwoRate
from stages.windows import Rest, Windows

Array = NDArray[np.float64]
INDICATOR, RATE = "indicator.", "rate."  # prefixes; RATE: of the logarithm of a fault's size, 1/s
NOISE = "noise_sd"  # of the measurement, in the output's unit
SIGNALS = "signals"
LEAST_WINDOWS = 3  # of a reference


@dataclass(frozen=True, eq=False)
class MonitorState:
    """Samples of unfinished windows; what the last fitted window left; ends of the last windows and the
    states there; the windows of the reference so far, what they say is healthy (None while they are too few),
    and what is held of the faults since the reference is complete."""

    rest: Rest
    memory: Memory | None
    ends: tuple[tuple[float, Array], ...]
    windows: tuple[Estimate, ...]
    reference: Reference | None
    belief: Belief


@dataclass(frozen=True, kw_only=True)
class Monitor:
    """``input`` and ``output``: the plant's input and the sensor's reading, at ``rate_hz``. ``sensor`` and
    ``plant`` name the indicators: ``tau_<sensor> k_<sensor> k_<plant> a1 a2 ...``.

    ``faults`` maps a fault to the factors by which it changes indicators, see
    :class:`stages.templates.Template`. ``plant_zeros``: how many zeros the plant has; they are estimated
    along. ``sensor_order``: 1, or 2 for a sensor of two lags or one that rings; then the first indicator is
    ``lag_<sensor>``, the sum of its lags, and their ratio is estimated along. ``drifting``: coefficients a_i
    that may drift inside a window.
    ``floor``: changes smaller than this are not told from the model's own imperfection. ``step_s``: from one
    window's start to the next; 0: they adjoin. ``estimator = "printed"``: Chapter III as printed, to compare.

    Raises:
        RecipeError: settings that are out of range, or a template that does not fit.
        LogError: another sampling rate than ``rate_hz``; fault-free logs without a usable window.
    """

    version: ClassVar[str] = "3"
    learns_from: ClassVar[Literal["training"]] = "training"
    starts_unfitted: ClassVar[bool] = True
    input: str
    output: str
    rate_hz: float
    sensor: str
    plant: str
    plant_order: int
    faults: Mapping[str, Mapping[str, str]]
    plant_zeros: int = 0
    sensor_order: int = 1
    drifting: tuple[int, ...] = ()
    window_s: float = 1.0
    step_s: float = 0.0
    decimation: int = 10
    horizon: int = 20
    reference_s: float = 15.0
    forgetting: float = 0.3
    alarm_evidence: float = 7.0
    change_sd: float = 0.3
    floor: float = 0.003
    estimator: EstimatorName = "innovations"
    learned: Arrays = field(default_factory=dict)

    def __post_init__(self) -> None:
        least = TwoRate(decimation=self.decimation, horizon=self.horizon).least_samples()
        samples = round(self.window_s * self.rate_hz)
        coefficients = range(1, self.plant_order + 1)
        rules = {
            f"plant_order = {self.plant_order} must be at least 1": self.plant_order >= 1,
            f"plant_zeros = {self.plant_zeros} must be 0 or more, and fewer than plant_order": (
                0 <= self.plant_zeros < max(self.plant_order, 1)
            ),
            f"sensor_order = {self.sensor_order} must be 1 or 2": self.sensor_order in (1, 2),
            "estimator = 'printed' knows a sensor of first order only": (
                self.estimator != "printed" or self.sensor_order == 1
            ),
            f"rate_hz = {self.rate_hz:g} must be positive": self.rate_hz > 0.0,
            f"reference_s = {self.reference_s:g} must be at least {LEAST_WINDOWS} windows": (
                self.reference_s >= LEAST_WINDOWS * self.window_s
            ),
            f"forgetting = {self.forgetting:g} must be in (0, 1]": 0.0 < self.forgetting <= 1.0,
            "change_sd must be positive, floor not negative": self.change_sd > 0.0 <= self.floor,
            f"window_s = {self.window_s:g} is {samples} samples; decimation and horizon need {least}": (
                samples >= least
            ),
            f"step_s = {self.step_s:g} must be 0, or a sample at least and window_s at most": (
                self.step_s == 0.0 or 1.0 / self.rate_hz <= self.step_s <= self.window_s
            ),
            f"drifting = {list(self.drifting)} must be among {list(coefficients)}": (
                set(self.drifting) <= set(coefficients)
            ),
        }
        if wrong := [text for text, holds in rules.items() if not holds]:
            raise RecipeError(f"monitor: {'; '.join(wrong)}")
        assert self._decision is not None

    @cached_property
    def indicators(self) -> tuple[str, ...]:
        coefficients = (f"a{i}" for i in range(1, self.plant_order + 1))
        delay = {1: "tau_", 2: "lag_"}[self.sensor_order]
        return (f"{delay}{self.sensor}", f"k_{self.sensor}", f"k_{self.plant}", *coefficients)

    @cached_property
    def _decision(self) -> Decision:
        templates = tuple(
            Template(fault=f, factors=factors, indicators=self.indicators)
            for f, factors in self.faults.items()
        )
        return Decision(
            templates=templates, forgetting=self.forgetting, change_sd=self.change_sd, floor=self.floor,
            share=self._windows.share,
        )  # fmt: skip

    @cached_property
    def _windows(self) -> Windows:
        length, hop = (round(s * self.rate_hz) for s in (self.window_s, self.step_s or self.window_s))
        return Windows(length=length, hop=hop, dt=1.0 / self.rate_hz)

    @cached_property
    def _estimator(self) -> Innovations | Printed:
        structure = Structure(
            plant_order=self.plant_order,
            zeros=self.plant_zeros,
            sensor_order=self.sensor_order,
            dt=1.0 / self.rate_hz,
            drifting=self.drifting,
        )
        if self.estimator == "printed":
            return Printed(structure=structure, horizon=self.horizon)
        start = TwoRate(decimation=self.decimation, horizon=self.horizon)
        return Innovations(structure=structure, start=start, share=self._windows.share)

    @property
    def needs(self) -> set[str]:
        return {self.input, self.output}

    @property
    def adds(self) -> set[str]:
        per_indicator = {kind + name for kind in (INDICATOR, SIGMA, Z) for name in self.indicators}
        per_fault = {kind + f for kind in (EVIDENCE, PROBABILITY, SIZE, SIZE_SD, RATE) for f in self.faults}
        return per_indicator | per_fault | {NOISE, DETECTION, EVIDENCE + UNKNOWN, PROBABILITY + UNKNOWN}

    def fit(self, blocks: Sequence[Log], before: Sequence[Sequence[Stage]] = (), /) -> Self:
        """The reference from fault-free logs: every usable window counts."""
        windows = tuple(e for block in blocks for _, e in self._fitted(self.start(), block)[1] if e)
        found = self._healthy(windows)
        if found is None:
            raise LogError(
                f"monitor: {len(windows)} usable windows in the fault-free logs; expected {LEAST_WINDOWS} or "
                "more that do not overlap"
            )
        return replace(
            self, learned={"mean": found.mean, "covariance": found.covariance, "spread": found.spread}
        )

    def refit(self, blocks: Sequence[Log], /) -> Self:
        return self.fit(blocks)

    def start(self) -> MonitorState:
        learned = Reference(**self.learned) if self.learned else None
        return MonitorState(self._windows.start(2), None, (), (), learned, self._decision.start())

    def step(self, state: MonitorState, block: Log, /) -> tuple[MonitorState, Log]:
        group, rows = block.groups[ANALYSIS], []
        state, estimates = self._fitted(state, block)
        for end, estimate in estimates:
            state, row = self._judge(state, estimate)
            rows.append({TIME: end, **row})
        frame = pl.DataFrame(rows, schema=self._schema)
        units = self._units(group.signals[self.output].unit)
        signals = {n: Signal(name=n, unit=units.get(n, "1")) for n in frame.columns[1:]}
        groups = {ANALYSIS: Group(ANALYSIS, frame, signals), SIGNALS: replace(group, name=SIGNALS)}
        return state, replace(block, groups=groups)

    def _fitted(
        self, state: MonitorState, block: Log
    ) -> tuple[MonitorState, list[tuple[float, Estimate | None]]]:
        """The state after the windows that the block completes, and end and estimate of each."""
        values = columns(block, [self.input, self.output])
        z = np.column_stack([values[self.input], values[self.output]])
        rest, windows = self._windows.cut(state.rest, block.groups[ANALYSIS].time, z)
        memory, ends, estimates = state.memory, state.ends, []
        for end, window in windows:
            u, y = np.ascontiguousarray(window.T)
            begin, apart = end - self.window_s, 0.5 / self.rate_hz
            before = next((x for e, x in ends if abs(e - begin) < apart), None)
            estimate = self._estimator.estimate(u, y, memory, before)
            estimates.append((end, estimate))
            if estimate is not None:
                memory = estimate.memory
            if estimate is not None and estimate.state is not None:
                ends = (*((e, x) for e, x in ends if e > begin + apart), (end, estimate.state))
        return replace(state, rest=rest, memory=memory, ends=ends), estimates

    def _healthy(self, windows: tuple[Estimate, ...]) -> Reference | None:
        """None where the windows are too few."""
        share = self._windows.share
        return Reference.of(windows, share) if len(windows) * share >= LEAST_WINDOWS else None

    @cached_property
    def _schema(self) -> dict[str, Any]:
        doubles = [kind + name for name in self.indicators for kind in (INDICATOR, SIGMA, Z)]
        faults = [*self.faults, UNKNOWN]
        schema: dict[str, Any] = {
            TIME: pl.Float64,
            **dict.fromkeys([*doubles, NOISE], pl.Float64),
            DETECTION: pl.Int8,
        }
        schema |= {kind + f: pl.Float32 for f in faults for kind in (EVIDENCE, PROBABILITY)}
        return schema | {kind + f: pl.Float64 for f in self.faults for kind in (SIZE, SIZE_SD, RATE)}

    def _units(self, output: str | None) -> dict[str, str | None]:
        """Units of values and sigmas; the plant's gain is one to the volt of ``std(w_p)``."""
        tau, k, _, *coefficients = self.indicators
        units = {tau: "s", k: output, **{a: f"1/s^{i}" for i, a in enumerate(coefficients, start=1)}}
        return {NOISE: output, **{kind + n: u for n, u in units.items() for kind in (INDICATOR, SIGMA)}}

    def _judge(self, state: MonitorState, estimate: Estimate | None) -> tuple[MonitorState, dict[str, Any]]:
        """The state after a window, and its row."""
        step_s = self.step_s or self.window_s
        complete = bool(self.learned) or len(state.windows) * step_s >= self.reference_s
        row: dict[str, Any] = {}
        if estimate is not None:
            row = self._indicator_columns(estimate, state.reference)
            if not complete:
                windows = (*state.windows, estimate)
                state = replace(state, windows=windows, reference=self._healthy(windows))
            elif state.reference is not None:
                belief = self._decision.add(state.belief, *state.reference.change(estimate))
                state = replace(state, belief=belief)
        return state, row | self._fault_columns(state)

    def _indicator_columns(self, estimate: Estimate, reference: Reference | None) -> dict[str, Any]:
        """Values, and sigma and z such that ``value - z sigma`` is the healthy value."""
        value = np.exp(estimate.x)
        row: dict[str, Any] = {NOISE: estimate.noise_sd}
        row |= {INDICATOR + name: v for name, v in zip(self.indicators, value, strict=True)}
        if reference is None:
            return row
        d, own = reference.change(estimate)
        own = own if estimate.still is None else estimate.still
        sd = np.sqrt(np.diag(own + reference.covariance))
        mean = np.where(d == 0.0, value, (value - np.exp(reference.mean)) / np.where(d == 0.0, 1.0, d))
        for i, name in enumerate(self.indicators):
            row |= {SIGMA + name: sd[i] * mean[i], Z + name: d[i] / sd[i]}
        return row

    def _fault_columns(self, state: MonitorState) -> dict[str, Any]:
        """Alarm, evidence, probabilities, and the faults' sizes at the window's end."""
        faults = [*self.faults, UNKNOWN]
        reference = state.reference
        if state.belief.windows == 0 or reference is None:
            return {DETECTION: 0, **{kind + f: 0.0 for f in faults for kind in (EVIDENCE, PROBABILITY)}}
        evidence = self._decision.evidence(state.belief, reference.covariance)
        alarm = float(evidence.max()) > self.alarm_evidence
        p = probabilities(evidence) if alarm else np.zeros(len(faults))
        row: dict[str, Any] = {DETECTION: int(alarm)}
        for fault, e, probability in zip(faults, evidence, p, strict=True):
            row |= {EVIDENCE + fault: e, PROBABILITY + fault: probability}
        for i, fault in enumerate(self.faults):
            eta, sd = self._decision.size(state.belief, i, reference.covariance, 0.5)
            row |= {SIZE + fault: np.expm1(eta), SIZE_SD + fault: np.exp(eta) * sd}
            row[RATE + fault] = state.belief.trends[i].slope[0] / self.window_s
        return row
