"""Several logs, or two diagnoses of one log, in one recording on one time axis."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import polars as pl
import rerun as rr
import rerun.blueprint as rrb

from ingest.errors import LogError
from ingest.log import Log
from stages.results import Diagnosis
from viz import send
from viz.colours import GREY, ORANGE, SKY_BLUE, of_fault, of_index
from viz.lanes import diagnosed, held, truth, truth_known
from viz.raster import curves
from viz.residuals import WIDTH, column, log_band, names, view_range
from viz.series import Array, break_at_gaps, lane
from viz.statistics import telling
from viz.summary import headline, magnitude_text, table
from viz.timeline import checked_span, write_recording
from viz.views import WholeRange, heights, key_signals, lane_view, plot, scale_text, signal_range

MOST, SIGNALS, RESIDUALS = 4, 3, 5
INJECTED, BAND_ALPHA = "/injected", 90
REACH = 12.0
"""z where a residual's plot ends."""
Shown = Diagnosis | Log


def write_beside(shown: Sequence[Shown], path: Path) -> None:
    """Logs or runs beside each other: each a column with its signals, residuals and lanes, all on one axis.

    Raises:
        LogError: there are more than :data:`MOST`, or what :func:`viz.timeline.write_timeline` raises.
    """
    if not 2 <= len(shown) <= MOST:
        raise LogError(f"{len(shown)} logs side by side: expected 2 to {MOST}; name fewer")
    logs = [_log(one) for one in shown]
    title = " | ".join(log.name for log in logs)

    def fill(rec: rr.RecordingStream) -> None:
        spans = [checked_span(log) for log in logs]
        columns = [_column(rec, f"{i + 1}", one) for i, one in enumerate(shown)]
        span = min(s for s, _ in spans), max(e for _, e in spans)
        rec.send_blueprint(_blueprint(rrb.Horizontal(*columns), span), make_active=True, make_default=True)

    write_recording(path, title, ["beside", title, [log.facts.get("sha256") for log in logs]], fill)


def write_comparison(first: Diagnosis, second: Diagnosis, path: Path, labels: tuple[str, str]) -> None:
    """Two diagnoses of one log on the same axes: each residual of both with its band, both verdicts.

    Raises:
        LogError: they have no residual in common, or what :func:`viz.timeline.write_timeline` raises.
    """
    common = [n for n in telling(first.samples) if n in dict(names(second.samples))]
    if not common:
        raise LogError(
            f"{first.log.name}: {first.verdict.recipe} and {second.verdict.recipe} have no residual in "
            "common; compare detectors of one recipe"
        )
    both = (first, second)

    def fill(rec: rr.RecordingStream) -> None:
        span = checked_span(first.log)
        views = [_compared(rec, name, both, labels) for name in common]
        roots = [f"{i}_{label}" for i, label in enumerate(labels, 1)]  # lanes stand in the order of paths
        lanes = [p for root, one in zip(roots, both, strict=True) for p in _found(rec, root, one)]
        lanes += _injected(rec, INJECTED, first.log)
        send.markdown(rec, "/summary", _verdicts(both, labels))
        below = [
            *lane_view("What each found", lanes),
            rrb.TextDocumentView(origin="/summary", name="Verdicts"),
        ]
        layout = rrb.Vertical(
            rrb.Grid(*views, grid_columns=1 if len(views) <= 2 else 2),
            rrb.Horizontal(*below, column_shares=[6, 4]),
            row_shares=[57, 43],
        )
        rec.send_blueprint(_blueprint(layout, span), make_active=True, make_default=True)

    identity = ["comparison", first.log.name, *labels, first.log.facts.get("sha256")]
    write_recording(path, f"{first.log.name}: {' | '.join(labels)}", identity, fill)


def _log(one: Shown) -> Log:
    return one.log if isinstance(one, Diagnosis) else one


def _blueprint(content: rrb.Container, span: tuple[float, float]) -> rrb.Blueprint:
    return WholeRange(
        content,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=send.TIMELINE, play_state="paused"),
        span=span,
    )


def _column(rec: rr.RecordingStream, root: str, one: Shown) -> rrb.Container:
    """A log's signals and, of a run, its residuals in sigma and lanes, below ``/<root>``."""
    log = _log(one)
    views = []
    for i, name in enumerate(key_signals(log, SIGNALS)):
        path = send.entity(root, "signals", name)
        time, values = curves(log.group_of(name), [name])
        send.lines(rec, path, time, values, names=[name], colours=[of_index(i)])
        unit = log.signals[name].unit or "?"
        views.append(plot(f"{name} [{unit}]", [path], signal_range(log.values(name)), legend=False))
    lanes: list[str] = []
    if isinstance(one, Diagnosis):
        for name, _ in names(one.samples)[:RESIDUALS]:
            path = send.entity(root, "z", name)
            _z(rec, path, one, name, SKY_BLUE, name)
            views.append(plot(f"{name} [sigma]", [f"{path}/**"], (-REACH, REACH), legend=False))
        lanes = _lanes(rec, root, one)
    head = f"{log.name}: {headline(one.verdict)}" if isinstance(one, Diagnosis) else log.name
    shares = heights([1.0] * len(views), lanes)
    return rrb.Vertical(*views, *lane_view(head, lanes), row_shares=shares, name=head)


def _compared(
    rec: rr.RecordingStream, name: str, both: tuple[Diagnosis, Diagnosis], labels: tuple[str, str]
) -> rrb.View:
    """A residual of both in its own unit, each line with its band of the same colour."""
    paths, ranges = [], []
    for one, label, colour in zip(both, labels, (SKY_BLUE, ORANGE), strict=True):
        paths.append(send.entity("residuals", name, label))
        samples, source = one.samples, dict(names(one.samples))[name]
        time, value, sigma = (column(samples, c) for c in ("time", source, f"sigma.{name}"))
        centre = value - column(samples, f"z.{name}") * sigma
        band = f"{label} ±{WIDTH:g} sigma"
        log_band(rec, f"{paths[-1]}/band", time, centre, sigma, band, (*colour, BAND_ALPHA))
        at, lines = break_at_gaps(time, value[:, None])
        send.lines(rec, f"{paths[-1]}/value", at, lines, names=[label], colours=[colour])
        ranges.append(view_range(value, centre, sigma))
    lows, highs = zip(*ranges, strict=True)
    shown = min(lows), max(highs)
    unit, (first, second) = both[0].units.get(name) or "1", labels
    colours = f"{first} blue, {second} orange, each with ±{WIDTH:g} sigma"
    title = f"{name} [{unit}] · {scale_text(shown)} · {colours}"
    return plot(title, [f"{path}/**" for path in paths], shown, legend=False)


def _z(
    rec: rr.RecordingStream, path: str, one: Diagnosis, name: str, colour: tuple[int, int, int], label: str
) -> None:
    time, z = column(one.samples, "time"), column(one.samples, f"z.{name}")
    at, lines = break_at_gaps(time, np.clip(z, -REACH, REACH)[:, None])
    ends = time[[0, -1]] if time.size else time
    middle, half = np.zeros(ends.size), np.full(ends.size, WIDTH)
    send.band(rec, f"{path}/usual", ends, middle, half, name="± 3 sigma", colour=(*GREY, 120))
    send.lines(rec, f"{path}/value", at, lines, names=[label], colours=[colour])


def _lanes(rec: rr.RecordingStream, root: str, one: Diagnosis) -> list[str]:
    return [*_found(rec, root, one), *_injected(rec, send.entity(root, "injected"), one.log)]


def _found(rec: rr.RecordingStream, root: str, one: Diagnosis) -> list[str]:
    path = send.entity(root, "diagnosed")
    at, states = lane(column(one.samples, "time"), diagnosed(one.samples))
    send.states(rec, path, at, states, {f: of_fault(f) for f in set(states) if f})
    return [path]


def _injected(rec: rr.RecordingStream, path: str, log: Log) -> list[str]:
    if not truth_known(log):
        return []
    time, kinds = held(truth(log), *log.span)
    shown = [k or "none" for k in kinds[:-1]] + [""]
    send.states(rec, path, time, shown, {f: of_fault(f) for f in set(shown) if f})
    return [path]


def _verdicts(both: tuple[Diagnosis, Diagnosis], labels: tuple[str, str]) -> str:
    def row(head: str, say: object) -> tuple[str, ...]:
        return (head, *(str(say(one)) for one in both))  # type: ignore[operator]

    def number(value: float | None) -> str:
        return "–" if value is None else f"{value:.1f} s"

    rows = [
        row("found", lambda d: d.verdict.fault),
        row("onset", lambda d: number(d.verdict.onset_s)),
        row("detected", lambda d: number(d.verdict.detected_s)),
        row("size", lambda d: magnitude_text(d.verdict.magnitude) if d.verdict.magnitude else "–"),
        row("its probability", _probability),
        row("detector", lambda d: (d.verdict.detector or "–")[:12]),
        *(
            row(f"{n}: rms z, no alarm", lambda d, n=n: _quiet(d.samples, n))
            for n, _ in names(both[0].samples)
        ),
    ]
    return f"## {both[0].log.name}\n\n" + table(("", *labels), rows)


def _probability(one: Diagnosis) -> str:
    p = one.verdict.probability.get(one.verdict.fault)
    return "–" if p is None else f"{p:.1%}"


def _quiet(samples: pl.DataFrame, name: str) -> str:
    if f"z.{name}" not in samples.columns:
        return "–"
    z: Array = column(samples.filter(pl.col("detection") == 0), f"z.{name}")
    z = z[np.isfinite(z)]
    return f"{np.sqrt(np.mean(z**2)):.2f}" if z.size else "–"
