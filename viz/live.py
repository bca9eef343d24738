"""A log as it is diagnosed, step by step, in a viewer that is open meanwhile."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import polars as pl
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from ingest.log import TIME, Log
from stages.results import DETECTION, EVIDENCE, PROBABILITY, Diagnosis, OperatingMap, Verdict
from viz import send
from viz.colours import DIM, EXCEEDANCE, GREY, SKY_BLUE, of_fault, of_index
from viz.evidence import LEADING
from viz.lanes import ALARM, DIAGNOSED, INJECTED, REGIME, diagnosed, held, regime_name, truth, truth_known
from viz.operating_map import MAP, log_cursor, log_regions
from viz.plane import Axes, frame
from viz.raster import curves
from viz.residuals import WIDTH, column, names
from viz.series import Array, at_times, changes
from viz.summary import WORDS, headline, summary
from viz.views import WholeRange, fault_lanes, heights, key_signals, map_view, plot, signal_range

SIGNALS, RESIDUALS = 3, 3
BAND = "/z_band"
REACH = 10.0
"""z where a residual's plot ends."""


class Live:
    """Draws a log while it is diagnosed into ``rec``: a layout first, then what each step brings.

    ``samples``: of the first step, for the names of its columns; ``plane``: the map of regimes, if any. Each
    residual is drawn in units of what is usual there and then, so that all have one scale from the start.
    """

    def __init__(
        self, rec: rr.RecordingStream, log: Log, samples: pl.DataFrame, plane: OperatingMap | None
    ) -> None:
        self.rec, self.log = rec, log
        self.signals = key_signals(log, SIGNALS)
        self.residuals = [name for name, _ in names(samples)]
        self.faults = [c.removeprefix(EVIDENCE) for c in samples.columns if c.startswith(EVIDENCE)]
        self.axes = _axes(log, plane)
        self.state: dict[str, str] = {}
        self.last: tuple[float, Array] | None = None
        """Time and place of the last point on the map."""
        self._styles(plane)
        rec.send_blueprint(self._layout(plane is not None), make_active=True, make_default=True)

    def step(self, part: Log | None, samples: pl.DataFrame, plane: OperatingMap | None) -> None:
        """The next stretch of the log and the samples that it has made."""
        if part is not None:
            for name in self.signals:
                group = part.group_of(name)
                if group.frame.height:
                    send.scalars(self.rec, send.entity("signals", name), *curves(group, [name]))
        if not samples.height:
            return
        time = column(samples, TIME)
        ends = time[[0, -1]]
        send.scalars(self.rec, BAND, ends, np.array([[-WIDTH, WIDTH]] * 2))
        for name in self.residuals:
            z = np.clip(column(samples, f"z.{name}"), -REACH, REACH)
            send.scalars(self.rec, send.entity("z", name), time, z)
        for root, prefix in (("probability", PROBABILITY), ("evidence", EVIDENCE)):
            for fault in self.faults:
                if prefix + fault in samples.columns:
                    path = send.entity(root, fault)
                    send.scalars(self.rec, path, time, column(samples, prefix + fault))
        self._lanes(samples, time)
        if plane is not None and self.axes is not None:
            self._map(time, self.axes.place(np.stack([plane.x, plane.y], axis=1)))

    def end(self, diagnosis: Diagnosis) -> None:
        """The verdict in the words of the whole log."""
        self.rec.set_time(send.TIMELINE, duration=self.log.span[1])
        self._say(summary(diagnosis))

    def _styles(self, plane: OperatingMap | None) -> None:
        """What each entity looks like, before it has values."""
        nothing = np.empty((0, 1))
        for i, name in enumerate(self.signals):
            path = send.entity("signals", name)
            send.lines(self.rec, path, nothing[:, 0], nothing, names=[name], colours=[of_index(i)])
        for name in self.residuals:
            path = send.entity("z", name)
            send.lines(self.rec, path, nothing[:, 0], nothing, names=[name], colours=[SKY_BLUE])
        edges = np.empty((0, 2))
        send.lines(self.rec, BAND, nothing[:, 0], edges, names=["-3 sigma", "+3 sigma"], colours=[GREY] * 2)
        for root in ("probability", "evidence"):
            for fault in self.faults:
                path = send.entity(root, fault)
                send.lines(self.rec, path, nothing[:, 0], nothing, names=[fault], colours=[of_fault(fault)])
        kinds = sorted({event.kind for event in truth(self.log)})
        known = ["none", "unknown", *self.faults]
        injected = ["none", *kinds, "+".join(kinds) or "none"] if truth_known(self.log) else []
        regimes = [] if plane is None else [regime_name(i) for i in range(len(plane.nodes))]
        for path, palette in (
            (ALARM, {"no alarm": DIM, "alarm": EXCEEDANCE}),
            (DIAGNOSED, {f: of_fault(f) for f in known}),
            (INJECTED, {f: of_fault(f) for f in injected}),
            (REGIME, {name: of_index(i) for i, name in enumerate(regimes)}),
        ):
            if palette:
                send.palette_of(self.rec, path, palette)
        if plane is not None and self.axes is not None:
            frame(self.rec, MAP, self.axes, plane.x_label, plane.y_label)
            log_regions(self.rec, self.axes.place(plane.nodes), plane)
        self.rec.set_time(send.TIMELINE, duration=self.log.span[0])
        self._say("## No alarm\n\nReplaying the log as it happened.")

    def _layout(self, mapped: bool) -> rrb.Blueprint:
        views = [
            plot(
                self._title(name),
                [send.entity("signals", name)],
                signal_range(self.log.values(name)),
                legend=False,
            )
            for name in self.signals
        ]
        views += [
            plot(
                f"{name}: deviation in sigma",
                [send.entity("z", name), BAND],
                (-REACH, REACH),
                legend=False,
            )
            for name in self.residuals[:RESIDUALS]
        ]
        faults = self.faults[:LEADING]
        told = [INJECTED] if truth_known(self.log) else []
        lanes = [ALARM, DIAGNOSED, *told, *([REGIME] if mapped else [])]
        left = rrb.Vertical(*views, *fault_lanes(lanes), row_shares=heights([1.0] * len(views), lanes))
        right: list[rrb.View] = [rrb.TextDocumentView(origin="/summary", name="Now")]
        if mapped:
            right.append(map_view())
        for title, root, scale in (
            ("Probability of each hypothesis", "probability", (-0.03, 1.03)),
            ("Evidence [nats: e times as likely]", "evidence", None),
        ):
            paths = [send.entity(root, f) for f in faults]
            right.append(plot(title, paths, scale, corner="RightTop"))  # where time comes last
        return WholeRange(
            rrb.Horizontal(
                left,
                rrb.Vertical(*right, row_shares=[3, 4, 3, 3] if mapped else [1, 1, 1]),
                column_shares=[2, 1],
            ),
            rrb.BlueprintPanel(state="collapsed"),
            rrb.SelectionPanel(state="collapsed"),
            rrb.TimePanel(state="collapsed", timeline=send.TIMELINE, play_state="following"),
            span=self.log.span,
        )

    def _title(self, name: str) -> str:
        return f"{name} [{self.log.signals[name].unit or '?'}]"

    def _lanes(self, samples: pl.DataFrame, time: Array) -> None:
        alarm = np.where(samples[DETECTION].to_numpy() > 0, "alarm", "no alarm")
        faults = diagnosed(samples)
        self._changes(ALARM, time, alarm)
        self._changes(DIAGNOSED, time, faults)
        if "regime" in samples.columns:
            regimes = samples["regime"].fill_null(-1).to_list()
            self._changes(REGIME, time, np.array([regime_name(r) for r in regimes]))
        if truth_known(self.log):
            edges, kinds = held(truth(self.log), *self.log.span)
            at = np.clip(np.searchsorted(edges, time, side="right") - 1, 0, len(kinds) - 1)
            self._changes(INJECTED, time, np.array([kinds[i] or "none" for i in at]))
        for row in changes(faults):
            self.rec.set_time(send.TIMELINE, duration=float(time[row]))
            self._status(str(faults[row]), samples.row(int(row), named=True))

    def _changes(self, path: str, time: Array, states: NDArray[Any]) -> None:
        """The rows of a lane at which it changes, also from step to step."""
        rows = [r for r in changes(states).tolist() if r or states[0] != self.state.get(path)]
        if rows:
            columns = rr.StateChange.columns(state=[str(states[r]) for r in rows])
            self.rec.send_columns(path, send.times(time[rows]), columns)
        self.state[path] = str(states[-1])

    def _status(self, fault: str, row: dict[str, object]) -> None:
        if fault == "none":
            self._say(f"## No alarm\n\nat {row[TIME]:.1f} s")
            return
        named = Verdict(log=self.log.name, recipe="", detector=None, fault=fault)
        ranked = sorted(
            ((row.get(PROBABILITY + f) or 0.0, f) for f in (*self.faults, "unknown")), reverse=True
        )
        likely = "\n".join(f"- {WORDS.get(f, f)}: {p:.0%}" for p, f in ranked[:4] if float(str(p)) > 0.005)
        self._say(f"## ALARM\n\n### {headline(named)}\n\nat {row[TIME]:.1f} s\n\n{likely}")

    def _say(self, text: str) -> None:
        self.rec.log("/summary", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))

    def _map(self, time: Array, placed: Array) -> None:
        if self.last is not None:
            time, placed = np.append(self.last[0], time), np.vstack([self.last[1], placed])
        log_cursor(self.rec, time, placed)
        self.last = float(time[-1]), placed[-1]


def _axes(log: Log, plane: OperatingMap | None) -> Axes | None:
    """The map's frame: around the regions and all that the log will bring."""
    if plane is None:
        return None
    points: Iterable[Array] = (plane.nodes,)
    x, y = (label.split(" [")[0] for label in (plane.x_label, plane.y_label))
    if x in log.signals and y in log.signals:
        time = log.group_of(x).time
        points = (plane.nodes, np.stack([log.values(x), at_times(log, y, time)], axis=1))
    return Axes.around(np.concatenate(list(points)))
