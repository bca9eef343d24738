"""A log that does not fit into memory, part by part, as one small enough to be drawn."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import polars as pl

from ingest.log import TIME, Group, Log
from viz.raster import in_order
from viz.series import changes, envelope
from viz.signals import ENVELOPE_POINTS

STATES = " states"
"""Appended to a group's name for its text: rows at which one of its states changes."""


class Reducer:
    """Takes the parts of a log and gives back the log, each group as the envelope of its numbers, about
    ``points`` rows in all, with each peak in place. ``rows``: of each whole group."""

    def __init__(self, rows: Mapping[str, int], points: int | None = None) -> None:
        self.rows, self.points = rows, points or ENVELOPE_POINTS
        self.frames: dict[str, list[pl.DataFrame]] = defaultdict(list)
        self.groups: dict[str, Group] = {}

    def add(self, part: Log) -> None:
        """The next part."""
        for key, group in part.groups.items():
            self._add_numbers(key, group)
            self._add_states(key, group)

    def _add_numbers(self, key: str, group: Group) -> None:
        schema = group.frame.schema
        names = [n for n in group.signals if schema[n].is_numeric()]
        if not names or not group.frame.height:
            return
        time, order = in_order(group)
        values = group.frame.select(pl.col(n).cast(pl.Float64).fill_null(float("nan")) for n in names)
        share = self.points * group.frame.height / max(self.rows.get(key, 0), group.frame.height)
        at, reduced = envelope(time, values.to_numpy()[order], max(2, round(share)))
        frame = pl.DataFrame({TIME: at, **{n: reduced[:, i] for i, n in enumerate(names)}})
        self._keep(key, replace(group, frame=frame, signals={n: group.signals[n] for n in names}))

    def _add_states(self, key: str, group: Group) -> None:
        schema = group.frame.schema
        names = [n for n in group.signals if schema[n] in (pl.String, pl.Boolean)]
        if not names or not group.frame.height:
            return
        _, order = in_order(group)
        frame = group.frame.select(TIME, *names)[order]
        rows = np.unique(
            np.concatenate([changes(frame[n].cast(pl.String).fill_null("").to_numpy()) for n in names])
        )
        frame = frame[np.append(rows, frame.height - 1)]
        self._keep(key + STATES, Group(key + STATES, frame, {n: group.signals[n] for n in names}))

    def _keep(self, key: str, group: Group) -> None:
        self.frames[key].append(group.frame)
        self.groups[key] = group

    def log(self, whole: Log) -> Log:
        """What has been taken in as a log, with the events and facts of ``whole``."""
        groups = {
            key: replace(group, frame=pl.concat(self.frames[key], how="vertical_relaxed"))
            for key, group in self.groups.items()
        }
        return replace(whole, groups=groups)
