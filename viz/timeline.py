"""A diagnosis or a log as one Rerun recording."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from ingest.errors import LogError
from ingest.log import Log
from stages.results import Chosen, Diagnosis, Verdict
from viz import send
from viz.distributions import log_distributions
from viz.evidence import log_evidence
from viz.lanes import log_event_lanes, log_lanes
from viz.layout import log_layout, run_layout
from viz.model import log_model
from viz.monitoring import log_monitoring
from viz.operating_map import log_operating_map
from viz.residuals import log_residuals
from viz.selection import log_selections, selection_tabs
from viz.signals import log_signals
from viz.summary import log_summary, regime_table, summary
from viz.viewer import check_folder

MOMENTS = 8
LATEST_S = 9.0e9  # Rerun counts nanoseconds in 64 bits


def write_timeline(diagnosis: Diagnosis, path: Path) -> None:
    """The Rerun recording of a run; ``path`` appears whole or not at all.

    Raises:
        LogError: the log has no samples or its time does not fit a timeline, or ``path`` cannot be written.
    """
    verdict = diagnosis.verdict
    identity = [verdict.log, verdict.recipe, verdict.detector, diagnosis.log.facts.get("sha256")]
    write_recording(path, diagnosis.log.name, identity, lambda rec: log_diagnosis(rec, diagnosis))


def write_log_timeline(log: Log, path: Path) -> None:
    """The Rerun recording of a log without a run; see :func:`write_timeline`."""
    write_recording(path, log.name, [log.name, log.facts.get("sha256")], lambda rec: log_log(rec, log))


def write_selections(chosen: Sequence[Chosen], name: str, path: Path) -> None:
    """The Rerun recording of input selections; see :func:`write_timeline`."""

    def fill(rec: rr.RecordingStream) -> None:
        log_selections(rec, chosen)
        panels = [
            panel(state="collapsed") for panel in (rrb.BlueprintPanel, rrb.SelectionPanel, rrb.TimePanel)
        ]
        layout = rrb.Blueprint(rrb.Tabs(*selection_tabs(chosen)), *panels)
        rec.send_blueprint(layout, make_active=True, make_default=True)

    write_recording(path, name, [name, *(asdict(one) for one in chosen)], fill)


def log_diagnosis(rec: rr.RecordingStream, diagnosis: Diagnosis) -> None:
    """Everything known of a run, and the layout that shows it, into ``rec``."""
    span = checked_span(diagnosis.log)
    contents = log_signals(rec, diagnosis.log, moments(diagnosis.log, diagnosis.verdict))
    residuals = log_residuals(rec, diagnosis)
    lanes = log_lanes(rec, diagnosis)
    log_evidence(rec, diagnosis)
    monitored = log_monitoring(rec, diagnosis)
    spread = log_distributions(rec, diagnosis)
    modelled = log_model(rec, diagnosis)
    log_selections(rec, diagnosis.about.selections if diagnosis.about else ())
    send.markdown(rec, "/summary", summary(diagnosis, contents.remarks))
    plane = diagnosis.operating_map
    if plane is not None:
        log_operating_map(rec, diagnosis, plane)
        send.markdown(rec, "/regimes", regime_table(diagnosis))
    layout = run_layout(
        diagnosis,
        contents,
        residuals,
        lanes,
        monitored=monitored,
        spread=spread,
        modelled=modelled,
        span=span,
    )
    rec.send_blueprint(layout, make_active=True, make_default=True)


def log_log(rec: rr.RecordingStream, log: Log) -> None:
    """A log's signals, events and facts, and the layout that shows them, into ``rec``."""
    span = checked_span(log)
    contents = log_signals(rec, log, moments(log))
    lanes = log_event_lanes(rec, log)
    send.markdown(rec, "/summary", log_summary(log, contents.remarks))
    rec.send_blueprint(log_layout(contents, lanes, span), make_active=True, make_default=True)


def moments(log: Log, verdict: Verdict | None = None) -> list[float]:
    """When what matters began, s: injected faults, onset and detection, other findings; the first few."""
    found = [event.t_start for event in log.events if event.source != "quality" and event.kind != "none"]
    if verdict is not None:
        told = [verdict.onset_s, verdict.detected_s, *(event.t_start for event in verdict.events)]
        found += [at for at in told if at is not None]
    return sorted(dict.fromkeys(found))[:MOMENTS]


def checked_span(log: Log) -> tuple[float, float]:
    """First and last time stamp in s.

    Raises:
        LogError: there are no samples, or a time stamp is beyond what a timeline can count.
    """
    start, end = log.span
    if not -LATEST_S < start <= end < LATEST_S:
        raise LogError(
            f"log {log.name!r}: time runs from {start:g} to {end:g}; expected seconds, at most {LATEST_S:g}. "
            "Map the time column with its unit"
        )
    return start, end


def application_id(name: str) -> str:
    """An application of its own for each log, since Rerun keeps one layout per application.

    >>> application_id("run/7.mf4")
    'dynoscope run 7 mf4'
    """
    return f"dynoscope {re.sub(r'[^A-Za-z0-9_ -]+', ' ', name)}".strip()[:180]


def write_recording(
    path: Path, name: str, identity: list[object], fill: Callable[[rr.RecordingStream], None]
) -> None:
    """A recording called ``name`` that ``fill`` writes; ``path`` appears whole or not at all. Its id is the
    digest of ``identity``.

    Raises:
        LogError: the folder of ``path`` does not exist.
    """
    check_folder(path)
    digest = hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:32]
    rec = rr.RecordingStream(application_id(name), recording_id=digest, send_properties=False)
    rec.set_log_time_enabled(False)
    aside = path.with_name(f".{path.name}.{os.getpid()}.rrd")
    try:
        rec.save(aside)
        rec.send_recording_name(name)
        fill(rec)
        rec.disconnect()
        aside.replace(path)
    finally:
        rec.disconnect()
        aside.unlink(missing_ok=True)
