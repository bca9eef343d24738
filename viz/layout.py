"""The blueprint: which view stands where, on one linked time axis that shows the whole log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import rerun.blueprint as rrb

from stages.results import Diagnosis, OperatingMap
from viz.distributions import LEADS, bounds
from viz.lanes import FAULT_LANES, INJECTED, REGIME
from viz.layers import residual_layers
from viz.model import MODEL
from viz.monitoring import ERRORS, POLES, READINGS, Monitored
from viz.operating_map import SOM, som_bounds
from viz.plane import plane_view
from viz.residuals import Residual
from viz.selection import selection_tabs
from viz.send import TIMELINE
from viz.series import TRUTH
from viz.signals import LogContents, Panel
from viz.views import (
    KEY_SIGNALS,
    Corner,
    WholeRange,
    fault_lanes,
    heights,
    lane_view,
    map_view,
    plot,
    scale_text,
)

OVERVIEW_PANELS = 2
OVERVIEW_RESIDUALS = 3
PANELS_PER_PAGE = 12
LANES_BELOW = 6


def log_layout(contents: LogContents, lanes: Sequence[str], span: tuple[float, float]) -> rrb.Blueprint:
    """A log without a run: signals beside what is known of it."""
    panels = overview_panels(contents.panels, 6)
    signals = [_signal_view(panel) for panel in panels]
    shares = heights([_tall(panel) for panel in panels], lanes)
    left = rrb.Vertical(*signals, *lane_view("Events", lanes), row_shares=shares)
    about = rrb.TextDocumentView(origin="/summary", name="Log")
    tabs = [rrb.Horizontal(left, about, column_shares=[7, 3], name="Overview"), *signal_tabs(contents)]
    return _blueprint(tabs, span)


def run_layout(
    diagnosis: Diagnosis,
    contents: LogContents,
    residuals: Sequence[Residual],
    lanes: Sequence[str],
    *,
    monitored: Monitored | None,
    spread: Mapping[str, str],
    modelled: bool,
    span: tuple[float, float],
) -> rrb.Blueprint:
    """A run: one tab per question."""
    plane = diagnosis.operating_map
    tabs = [
        _overview(contents, residuals, lanes, plane is not None),
        *signal_tabs(contents),
        _residuals(residuals, lanes, diagnosis),
        *([_regimes(plane)] if plane else []),
        *([_compensation(monitored, lanes)] if monitored else []),
        _evidence(lanes, diagnosis),
        *([_distributions(spread, diagnosis)] if spread else []),
        *([_model()] if modelled else []),
        *selection_tabs(diagnosis.about.selections if diagnosis.about else ()),
    ]
    return _blueprint(tabs, span)


def _blueprint(tabs: Sequence[rrb.Container], span: tuple[float, float]) -> rrb.Blueprint:
    return WholeRange(
        rrb.Tabs(*tabs, active_tab=0),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="paused"),
        span=span,
    )


def _overview(
    contents: LogContents, residuals: Sequence[Residual], lanes: Sequence[str], operating_map: bool
) -> rrb.Container:
    panels = overview_panels(contents.panels, OVERVIEW_PANELS)
    signals = [_signal_view(panel) for panel in panels]
    tall = [_tall(panel) for panel in panels]
    shown = [_residual_view(r, lanes) for r in residuals[:OVERVIEW_RESIDUALS]]
    left = rrb.Vertical(
        *signals,
        *shown,
        *fault_lanes(lanes),
        row_shares=heights(tall + [2.6] * len(shown), lanes),
    )
    right: list[rrb.View] = [rrb.TextDocumentView(origin="/summary", name="Summary")]
    if operating_map:
        right.append(map_view())
    return rrb.Horizontal(
        left, rrb.Vertical(*right, row_shares=[5, 4][: len(right)]), column_shares=[7, 3], name="Overview"
    )


def _tall(panel: Panel) -> float:
    """The share of a column that a panel needs: its legend has a row for each line."""
    return 1.6 + 0.4 * min(len(panel.lines), 5)


def overview_panels(panels: Sequence[Panel], count: int) -> list[Panel]:
    """The panels that hold the key signals, in their order, then the first others."""
    keyed = [panel for key in KEY_SIGNALS for panel in panels if key in panel.signals]
    measured = [panel for panel in panels if not all(name.startswith(TRUTH) for name in panel.signals)]
    return list(dict.fromkeys([*keyed, *(measured or panels)]))[:count]


def signal_tabs(contents: LogContents) -> list[rrb.Container]:
    """The tab of all signals, with pages where they do not fit on one; text as lanes below, or on a page."""
    views = [_signal_view(panel) for panel in contents.panels]
    count = -(-len(views) // PANELS_PER_PAGE)
    parts = [views[len(views) * i // count : len(views) * (i + 1) // count] for i in range(count)]
    pages = [_grid(part, f"Page {i + 1}") for i, part in enumerate(parts)]
    lanes = lane_view("States", contents.lanes)
    if len(pages) == 1 and len(contents.lanes) <= LANES_BELOW:
        return [rrb.Vertical(pages[0], *lanes, row_shares=heights([1.0], contents.lanes), name="Signals")]
    pages += [rrb.Vertical(view, name="States") for view in lanes]
    return [rrb.Tabs(*pages, name="Signals")] if pages else []


def _grid(views: Sequence[rrb.View], name: str | None = None) -> rrb.Container:
    return rrb.Grid(*views, grid_columns=1 if len(views) <= 5 else 2, name=name)


def _residuals(residuals: Sequence[Residual], lanes: Sequence[str], diagnosis: Diagnosis) -> rrb.Container:
    monitors = any(c.startswith("indicator.") for c in diagnosis.samples.columns)
    name = "Indicators" if monitors else "Residuals"
    plots = _grid([_residual_view(residual, lanes, legend=len(residuals) <= 3) for residual in residuals])
    shown = [lane for lane in lanes if lane in (*FAULT_LANES, REGIME)]
    return rrb.Vertical(plots, *fault_lanes(shown), row_shares=heights([1.0], shown), name=name)


def _regimes(plane: OperatingMap) -> rrb.Container:
    low, high = (f"{f(plane.spread):.3g}" if plane.spread.size else "–" for f in (min, max))
    title = f"Self-organising map · size: training samples · colour: spread, {low} dark to {high} bright"
    som = plane_view(SOM, title, som_bounds(plane))
    tables = rrb.TextDocumentView(origin="/regimes", name="Residuals by regime")
    return rrb.Horizontal(map_view(), rrb.Vertical(som, tables, row_shares=[4, 5]), name="Regimes")


def _evidence(lanes: Sequence[str], diagnosis: Diagnosis) -> rrb.Container:
    shown = [lane for lane in lanes if lane in FAULT_LANES]
    time, alarm = diagnosis.samples["time"].to_numpy(), diagnosis.samples["detection"].to_numpy() > 0
    early = bool(alarm[time < 0.85 * time[0] + 0.15 * time[-1]].any()) if time.size else False
    corner: Corner = "RightBottom" if early else "LeftTop"  # the lines begin to rise at the alarm
    title = "Probability of each hypothesis [1]"
    views = [plot(title, ["/probability/leading"], (-0.03, 1.03), corner=corner)]
    if any(c.startswith("evidence.") for c in diagnosis.samples.columns):
        words = "Evidence for each hypothesis [nats: 1 makes it e times as likely as no fault]"
        views.append(plot(words, ["/evidence/leading"], corner=corner))
    shares = heights([1.0] * len(views), shown)
    return rrb.Vertical(*views, *fault_lanes(shown), row_shares=shares, name="Evidence")


def _distributions(spread: Mapping[str, str], diagnosis: Diagnosis) -> rrb.Container:
    views: list[rrb.View] = []
    for path, title in spread.items():
        if path == LEADS:
            views.append(rrb.TextDocumentView(origin=path, name=title))
        else:
            views.append(plane_view(path, title, bounds(path, diagnosis)))
    return rrb.Grid(*views, grid_columns=3 if len(views) == 3 else 2, name="Distributions")


def _model() -> rrb.Container:
    """What the detector is made of."""
    views: list[rrb.View] = [rrb.TextDocumentView(origin=MODEL, name="What the detector is made of")]
    return rrb.Horizontal(*views, name="Model")


def _compensation(monitored: Monitored, lanes: Sequence[str]) -> rrb.Container:
    shown = [lane for lane in lanes if lane in FAULT_LANES]
    plots = [
        plot(title, [path], range_)
        for path, drawn in ((READINGS, monitored.readings), (ERRORS, monitored.errors))
        if drawn
        for title, range_ in [drawn]
    ]
    parts: list[Any] = []
    if plots:
        shares = heights([1.0] * len(plots), shown)
        parts.append(rrb.Vertical(*plots, *fault_lanes(shown), row_shares=shares))
    if monitored.poles:
        title = "Poles of plant and sensor · distance in decades · dark to bright: time · white: cursor"
        parts.append(plane_view(POLES, title, monitored.poles))
    return rrb.Horizontal(*parts, column_shares=[3, 2][: len(parts)], name="Compensation")


def _signal_view(panel: Panel) -> rrb.TimeSeriesView:
    drawn: dict[str, list[Any]] = {}
    for line in panel.lines:
        drawn.setdefault(line.entity, []).append(line.visualizer())
    return plot(panel.title, drawn, panel.range, legend=len(panel.lines) > 1, drawn=drawn)


def _residual_view(residual: Residual, lanes: Sequence[str], legend: bool = False) -> rrb.TimeSeriesView:
    known = " · white: injected" if INJECTED in lanes else ""
    marks = f"grey: ±3 sigma · red: beyond · yellow: alarm{known}"
    title = f"{residual.title} · {scale_text(residual.range)} · {marks}"
    paths = [f"{residual.path}/**", f"{residual_layers(residual.name)}/**"]
    return plot(title, paths, residual.range, legend=legend)
