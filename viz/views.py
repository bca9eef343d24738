"""Views of which layouts are made: plots and lanes on one linked time axis that shows the whole log."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ingest.log import Log
from viz.lanes import DIAGNOSED, INJECTED
from viz.layers import FINDINGS
from viz.operating_map import MAP, TRAIL_S
from viz.plane import FRAMED, plane_view
from viz.send import TIMELINE
from viz.series import TRUTH, Array, limits

KEY_SIGNALS = ("n_Eng", "p_Int", "W_HFM", "e_a", "theta_ang", "v_Veh")
LANES_HEAD, LANE = 0.058, 0.042  # of a screen's height
_GLOBAL_VIEW = "view/5c0dca6a-e63f-9cf7-f657-2602590474cc"  # of the viewer, re_viewer_context; not public
Corner = Literal["LeftTop", "RightTop", "RightBottom"]


class WholeRange(rrb.Blueprint):
    """A blueprint whose linked views open on ``span`` (s).

    Linked plots share a range that has no public setting and else opens 30 s around the cursor.
    """

    def __init__(self, *parts: Any, span: tuple[float, float], **settings: Any) -> None:
        super().__init__(*parts, **settings)
        self.span = span

    def _log_to_stream(self, stream: rr.RecordingStream) -> None:
        super()._log_to_stream(stream)
        start, end = (rr.TimeRangeBoundary.absolute(seconds=t) for t in self.span)
        axis = rrb.archetypes.TimeAxis(view_range=rr.TimeRange(start=start, end=end))
        stream.log(f"{_GLOBAL_VIEW}/TimeAxis", axis)


def heights(plots: Sequence[float], lanes: Sequence[str]) -> list[float]:
    """Shares of a column's height: as much for the lanes as they need, the rest for the plots."""
    below = [LANES_HEAD + LANE * len(lanes)] if lanes else []
    rest = max(1.0 - sum(below), 0.3)
    return [share / sum(plots) * rest for share in plots] + below


def key_signals(log: Log, count: int) -> list[str]:
    """The first ``count`` numeric signals of a log: the key ones, then others that were measured."""
    numeric = [n for g in log.groups.values() for n in g.signals if g.frame.schema[n].is_numeric()]
    ranked = [n for n in KEY_SIGNALS if n in numeric] + [n for n in numeric if not n.startswith(TRUTH)]
    return list(dict.fromkeys(ranked))[:count]


def signal_range(values: Array) -> tuple[float, float]:
    """Round limits around the finite values."""
    known = values[np.isfinite(values)]
    return limits(float(known.min()), float(known.max())) if known.size else (0.0, 1.0)


def map_view() -> rrb.Spatial2DView:
    trail = rrb.VisibleTimeRanges(
        timeline=TIMELINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-TRAIL_S),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    title = f"Operating map · samples by regime · white: cursor and the {TRAIL_S:.0f} s before"
    return plane_view(MAP, title, FRAMED, {f"{MAP}/trail": [trail]})


def scale_text(shown: tuple[float, float]) -> str:
    """How far a plot's axis reaches; low plots have few ticks.

    >>> scale_text((-0.34, 0.34)), scale_text((810.0, 1200.0))
    ('scale ±0.34', 'scale 810 to 1200')
    """
    low, high = (float(f"{v:.2g}") for v in shown)
    return f"scale ±{high:g}" if low == -high else f"scale {low:g} to {high:g}"


def plot(
    name: str,
    paths: Iterable[str],
    range_: tuple[float, float] | None = None,
    *,
    legend: bool = True,
    corner: Corner = "LeftTop",
    drawn: dict[Any, Any] | None = None,
) -> rrb.TimeSeriesView:
    """A plot of the entities ``paths``, drawn as they say of themselves or as ``drawn`` has it; the legend is
    in a ``corner``, since Rerun has no place for it beside the plot."""
    return rrb.TimeSeriesView(
        origin="/",
        contents=[f"+ {path}" for path in paths],
        name=name,
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        axis_y=rrb.ScalarAxis(range=range_) if range_ else None,
        plot_legend=rrb.PlotLegend(corner=corner, visible=legend),
        overrides=drawn,
    )


def fault_lanes(paths: Sequence[str]) -> list[rrb.StateTimelineView]:
    """The lanes of what was found, and of what was injected where that is known."""
    return lane_view("What was injected, what was found" if INJECTED in paths else "What was found", paths)


def lane_view(name: str, paths: Sequence[str]) -> list[rrb.StateTimelineView]:
    if not paths:
        return []
    axis = rrb.TimeAxis(link="LinkToGlobal")
    contents = [f"+ {path}" for path in paths] + ([f"+ {FINDINGS}/**"] if DIAGNOSED in paths else [])
    return [rrb.StateTimelineView(origin="/", contents=contents, name=name, time_view=axis)]
