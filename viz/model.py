"""What the detector is made of: its models with their inputs and fit, and what each residual means."""

from __future__ import annotations

import rerun as rr

from stages.results import About, Diagnosis
from viz import send
from viz.summary import table

MODEL = "/model"


def log_model(rec: rr.RecordingStream, diagnosis: Diagnosis) -> bool:
    """The description below ``/model``; whether there is one."""
    if diagnosis.about is None:
        return False
    send.markdown(
        rec, MODEL, model_text(diagnosis.about, diagnosis.verdict.recipe, diagnosis.verdict.detector)
    )
    return True


def model_text(about: About, recipe: str, detector: str | None) -> str:
    """The description in words (Markdown)."""
    parts = [f"## {recipe}" + (f", detector {detector[:12]}" if detector else "")]
    if about.models:
        rows = [
            (
                m.name, m.output, ", ".join(m.inputs) or "–", "data" if m.selected else "recipe",
                "–" if m.regions is None else str(m.regions),
                "–" if m.rms is None else f"{m.rms:.3g} {m.unit}".rstrip(),
            )
            for m in about.models
        ]  # fmt: skip
        head = ("model", "predicts", "from", "chosen by", "regions", "rms error in training")
        parts += ["### Models of the healthy system", table(head, rows)]
    if about.residuals:
        parts += ["### What each residual is", table(("residual", "is"), about.residuals.items())]
    learned = [
        *(f"training: {log}" for log in about.training),
        *(f"calibration: {log}" for log in about.calibration), *about.notes,
    ]  # fmt: skip
    if learned:
        parts.append("### Learned from\n" + "\n".join(f"- {line}" for line in learned))
    return "\n\n".join(parts)
