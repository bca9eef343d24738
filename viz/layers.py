"""A later diagnosis as a layer: a small recording that a viewer shows inside the one of an earlier run.

Rerun puts recordings of one id together. The layout of a run has a place for layers: their residuals beside
its own, on the same axes, and their findings among its lanes. The earlier recording is not rewritten.
"""

from __future__ import annotations

import os
from pathlib import Path

import rerun as rr

from ingest.errors import LogError
from stages.results import Diagnosis
from viz import send
from viz.colours import ORANGE, of_fault
from viz.lanes import diagnosed
from viz.residuals import column, names
from viz.series import break_at_gaps, lane
from viz.viewer import check_folder

RESIDUALS, FINDINGS = "/layers/residuals", "/layers/found"


def residual_layers(name: str) -> str:
    """Where layers have what they say of a residual."""
    return f"{RESIDUALS}{send.entity(name)}"


def write_layer(diagnosis: Diagnosis, base: Path, path: Path, label: str) -> None:
    """What ``diagnosis`` says, called ``label``, as a layer of the recording ``base``; ``path`` appears whole
    or not at all. Opened together, a viewer shows them as one.

    Raises:
        LogError: ``base`` is no recording or several, or the folder of ``path`` does not exist.
    """
    application, recording = _identity(base)
    check_folder(path)
    rec = rr.RecordingStream(application, recording_id=recording, send_properties=False)
    rec.set_log_time_enabled(False)
    aside = path.with_name(f".{path.name}.{os.getpid()}.rrd")
    try:
        rec.save(aside)
        _fill(rec, diagnosis, label)
        rec.disconnect()
        aside.replace(path)
    finally:
        rec.disconnect()
        aside.unlink(missing_ok=True)


def _identity(base: Path) -> tuple[str, str]:
    from rerun.chunk import RrdReader

    try:
        (found,) = RrdReader(base).recordings()
    except (OSError, ValueError, RuntimeError) as error:
        raise LogError(f"{base} is not the recording of one run: {error}") from None
    return str(found.application_id), str(found.recording_id)


def _fill(rec: rr.RecordingStream, diagnosis: Diagnosis, label: str) -> None:
    samples = diagnosis.samples
    time = column(samples, "time")
    for name, source in names(samples):
        at, values = break_at_gaps(time, column(samples, source)[:, None])
        path = f"{residual_layers(name)}{send.entity(label)}"
        send.lines(rec, path, at, values, names=[label], colours=[ORANGE], width=1.0)
    at, states = lane(time, diagnosed(samples))
    palette = {fault: of_fault(fault) for fault in set(states) if fault}
    send.states(rec, f"{FINDINGS}{send.entity(label)}", at, states, palette)
