"""A batch at a glance: every log's verdict in a table, and what was found when, one lane a log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl
import rerun as rr
import rerun.blueprint as rrb

from stages.results import Magnitude
from viz import send
from viz.colours import DIM, of_fault
from viz.drift import Drifted, log_drift
from viz.lanes import diagnosed
from viz.residuals import column
from viz.series import lane
from viz.summary import WORDS, magnitude_text, table
from viz.tables import judged
from viz.timeline import write_recording
from viz.views import WholeRange, lane_view
from viz.wear import Worn, log_wear

PER_PAGE = 24
SAMPLES = ("time", "detection")
"""Columns needed of a log's samples, besides its probabilities."""
Row = Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class Overviewed:
    """A log of a batch: its row of the summary, and its samples (``time``, ``detection``, ``p.*``) where it
    has any."""

    row: Row
    samples: pl.DataFrame | None


def write_overview(
    name: str,
    logs: Sequence[Overviewed],
    path: Path,
    opened: int,
    drift: Drifted | None = None,
    worn: Sequence[Worn] = (),
) -> None:
    """The overview of a batch as a recording of its own, beside those of ``opened`` logs, with its ``drift``
    and the wear of its vehicles (``worn``) as tabs; ``path`` appears whole or not at all."""

    def fill(rec: rr.RecordingStream) -> None:
        span, pages = _lanes(rec, logs)
        send.markdown(rec, "/summary", overview_text(name, [one.row for one in logs], opened))
        about = rrb.TextDocumentView(origin="/summary", name="Verdicts")
        tabs = rrb.Tabs(*pages) if len(pages) > 1 else pages[0] if pages else None
        layout: rrb.Container = (
            rrb.Horizontal(tabs, about, column_shares=[1, 1]) if tabs else rrb.Horizontal(about)
        )
        over_logs = {"Drift": log_drift(rec, drift) if drift else [], "Wear": log_wear(rec, worn)}
        more = [
            rrb.Grid(*views, grid_columns=2 if len(views) <= 4 else 3, name=tab)
            for tab, views in over_logs.items()
            if views
        ]
        if more:
            layout = rrb.Tabs(rrb.Horizontal(layout, name="Verdicts"), *more)
        blueprint = WholeRange(
            layout,
            rrb.BlueprintPanel(state="expanded"),  # the list of recordings, from here into a log
            rrb.SelectionPanel(state="collapsed"),
            rrb.TimePanel(state="collapsed", timeline=send.TIMELINE, play_state="paused"),
            span=span,
        )
        rec.send_blueprint(blueprint, make_active=True, make_default=True)

    write_recording(
        path, f"0 all logs of {name}", ["overview", name, [str(o.row["log"]) for o in logs]], fill
    )


def _lanes(rec: rr.RecordingStream, logs: Sequence[Overviewed]) -> tuple[tuple[float, float], list[rrb.View]]:
    """A lane of each log that has samples; the time they span from each log's start, and pages of lanes."""
    paths, end = [], 1.0
    for one in logs:
        if one.samples is None or not one.samples.height:
            continue
        time = column(one.samples, "time")
        time = time - time[0]
        end = max(end, float(time[-1]))
        at, states = lane(time, diagnosed(one.samples))
        paths.append(send.entity(str(one.row["log"])))
        send.states(rec, paths[-1], at, states, {f: of_fault(f) for f in set(states) if f} | {"none": DIM})
    paths.sort()
    pages = [paths[i : i + PER_PAGE] for i in range(0, len(paths), PER_PAGE)]
    title = "What was found when, from each log's start"
    named = [f"{title} ({i} of {len(pages)})" if len(pages) > 1 else title for i in range(1, len(pages) + 1)]
    views = [v for name, part in zip(named, pages, strict=True) for v in lane_view(name, part)]
    return (0.0, end), list(views)


def overview_text(name: str, rows: Sequence[Row], opened: int) -> str:
    """Counts and the table of verdicts (Markdown)."""
    faulty = [r for r in rows if r["fault"] not in (None, "none", "insufficient_evidence")]
    told = [judged(r) for r in rows if judged(r)]
    counts = [
        f"{len(rows)} logs", f"{len(faulty)} with a fault",
        f"{sum(r['fault'] == 'none' for r in rows)} fault-free",
        f"{sum(r['status'] == 'failed' for r in rows)} failed",
        *([f"{told.count('correct')} of {len(told)} right of those whose truth is known"] if told else []),
    ]  # fmt: skip
    body = [
        (
            str(r["log"]), WORDS.get(r["fault"], str(r["fault"])) if r["fault"] else f"failed: {r['reason']}",
            _size(r), "" if r["detected_s"] is None else f"{r['detected_s']:.0f} s", judged(r) or "",
        )
        for r in rows
    ]  # fmt: skip
    head = ("log", "verdict", "size", "detected", "against the truth")
    into = "Open a log in the list on the left."
    if opened < sum(r["status"] != "failed" for r in rows):
        into += f" {opened} are there, those with a fault first; any other with `dynoscope view {name}/LOG`."
    return f"## {name}\n\n{' · '.join(counts)}\n\n{into}\n\n{table(head, body)}"


def _size(row: Row) -> str:
    if row["magnitude"] is None:
        return ""
    size = Magnitude(value=row["magnitude"], sd=row["magnitude_sd"], unit=row["unit"] or "1")
    return magnitude_text(size)
