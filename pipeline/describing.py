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
    yield f"tau_{stage.sensor}", "time constant of the sensor"
    yield f"k_{stage.sensor}", "gain of the sensor"
    yield f"k_{stage.plant}", "gain of the plant"
    for i in range(1, stage.plant_order + 1):
        yield f"a{i}", f"coefficient of s^{stage.plant_order - i} in the plant's denominator"
