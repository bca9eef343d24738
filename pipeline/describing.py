"""What a detector is made of, in plain values that pictures and reports show."""

from __future__ import annotations

from collections.abc import Iterator

from pipeline.detector import Detector
from stages.monitor import Monitor
from stages.narx import Narx
from stages.relations import Relations
from stages.residuals import Residuals
from stages.results import About, Model
from stages.select_inputs import SelectInputs
from stages.stage import Stage


def about(detector: Detector) -> About:
    """The models of a detector, the formulas of its residuals or indicators, and what it learned from."""
    selected = {
        name for s in detector.stages if isinstance(s, SelectInputs) and s.learned for name in s.targets
    }
    formulas = {n: f for s in detector.stages if isinstance(s, Residuals) for n, f in s.residuals.items()}
    indicators = {n: w for s in detector.stages if isinstance(s, Monitor) for n, w in _indicators(s)}
    return About(
        models=tuple(m for stage in detector.stages for m in _models(stage, selected)),
        selections=tuple(
            s.portrait(name) for s in detector.stages if isinstance(s, SelectInputs) and s.learned
            for name in s.targets
        ),
        residuals=formulas | indicators,
        training=_logs(detector, "training"), calibration=_logs(detector, "calibration"),
        notes=tuple(detector.record.get("notes", ())),
    )  # fmt: skip


def _logs(detector: Detector, kind: str) -> tuple[str, ...]:
    return tuple(f"{s['log']}, {s['start_s']:g} to {s['end_s']:g} s" for s in detector.record.get(kind, ()))


def _models(stage: Stage, selected: set[str]) -> Iterator[Model]:
    if isinstance(stage, Relations) and stage.learned:
        for name, model in stage.models.items():
            relation = stage.relations[name]
            yield Model(
                name=name, output=relation.output, inputs=stage.inputs(name), unit=relation.unit,
                regions=len(model.theta), rms=float(model.rms), selected=name in selected,
            )  # fmt: skip
    elif isinstance(stage, Narx) and stage.learned:
        for name, model in stage.fitted.items():
            yield Model(
                name=name, output=stage.models[name], inputs=stage.inputs(name), regions=len(model.theta),
                rms=float(model.rms), selected=name in selected,
            )  # fmt: skip
    elif isinstance(stage, Monitor):
        yield Model(name=f"{stage.plant} {stage.sensor}", output=stage.output, inputs=(stage.input,))


def _indicators(stage: Monitor) -> Iterator[tuple[str, str]]:
    lag = "time constant of the sensor" if stage.sensor_order == 1 else "sum of the sensor's lags"
    words = [lag, "gain of the sensor", "gain of the plant"]
    powers = reversed(range(stage.plant_order))
    words += (f"coefficient of s^{power} in the plant's denominator" for power in powers)
    yield from zip(stage.indicators, words, strict=True)
