"""Verdict: a log's samples in a few words.

Alarms that lie less than ``merge_s`` apart are one event. Its fault is the one with the largest probability
at its end (more exactly: at its last sample in alarm with half its largest evidence), its confidence that
probability, and the log's verdict is that of its strongest event, the one with the largest evidence reached.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.log import TIME, Event, Log
from stages.gate import GATE
from stages.relations import IN_DOMAIN
from stages.residuals import SIGMA, Z
from stages.results import (
    DETECTABLE,
    DETECTION,
    EVIDENCE,
    OF,
    PAIR,
    PROBABILITY,
    SENSOR,
    SIZE,
    SIZE_SD,
    STATISTIC,
    UNKNOWN,
    Magnitude,
    Verdict,
)

ONSET_BACK_S, ONSET_AFTER_S = 600.0, 30.0
ROWS = 1 << 16  # looked at at once: bounds memory


class Table(Protocol):
    """What is asked of the samples: a frame, or columns that are read when they are needed."""

    @property
    def columns(self) -> list[str]: ...
    @property
    def height(self) -> int: ...
    def __getitem__(self, column: str, /) -> pl.Series: ...
    def select(self, columns: list[str], /) -> Table: ...
    def slice(self, offset: int, length: int | None = None) -> pl.DataFrame: ...


@dataclass(frozen=True, kw_only=True)
class Judge:
    """``min_evidence_s``: seconds of usable samples below which no alarm means nothing; ``channels``: the
    sensor that a fault concerns, if one; ``units``: of faults' sizes; ``alike``: groups of three faults of
    which two at once, both of about the opposite size, look like the third alone: ``statistics["same_as"]``
    names them beside it."""

    min_evidence_s: float = 45.0
    merge_s: float = 10.0
    channels: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    alike: tuple[tuple[str, ...], ...] = ()

    def verdict(
        self,
        log: Log,
        samples: Table,
        *,
        recipe: str,
        detector: str | None,
        quality: Mapping[str, Any],
    ) -> Verdict:
        """The verdict on ``log`` from its ``samples`` (columns as in :class:`stages.results.Diagnosis`)."""
        usable = usable_seconds(samples)
        statistics: dict[str, Any] = {"usable_s": round(usable, 3), "residuals": residual_statistics(samples)}
        if truth := {e.kind for e in log.events if e.source == "truth"}:
            statistics["truth"] = sorted(truth - {"none"}) or ["none"]
        none = Verdict(
            log=log.name, recipe=recipe, detector=detector, quality=quality, statistics=statistics,
            fault="none" if usable >= self.min_evidence_s else "insufficient_evidence",
            detectable=detectable(samples),
        )  # fmt: skip
        episodes = self._episodes(samples)
        if not episodes:
            return none
        strength, rows = zip(*(_strongest(samples, first, last) for first, last in episodes), strict=True)
        events = [self._event(samples, *episode, row) for episode, row in zip(episodes, rows, strict=True)]
        chosen = int(np.argmax(strength))
        event, row = events[chosen], rows[chosen]
        probability = self._probability(samples, row)
        if sizes := self._magnitudes(samples, event.kind, row):
            statistics["magnitudes"] = {f: asdict(size) for f, size in sizes.items()}
        if same := self._same_as(event.kind):
            statistics["same_as"] = same
        return replace(
            none,
            fault=event.kind,
            signal=event.channel,
            set=tuple(f for f, p in sorted(probability.items(), key=lambda x: -x[1]) if p > 0.05),
            probability=probability,
            onset_s=event.t_start,
            detected_s=float(samples[TIME][episodes[chosen][0]]),
            magnitude=self._magnitude(samples, event.kind, row, _sensor(samples, event.kind, row) or ""),
            events=tuple(events),
        )

    def _episodes(self, samples: Table) -> list[tuple[int, int]]:
        """First and last row of each alarm, close ones merged."""
        rows = np.flatnonzero(samples[DETECTION].to_numpy() > 0)
        if not rows.size:
            return []
        time = samples[TIME].to_numpy()
        breaks = np.flatnonzero((np.diff(rows) > 1) & (np.diff(time[rows]) > self.merge_s))
        starts, ends = np.append(0, breaks + 1), np.append(breaks, rows.size - 1)
        return [(int(rows[a]), int(rows[b])) for a, b in zip(starts, ends, strict=True)]

    def _probability(self, samples: Table, row: int) -> dict[str, float]:
        there = _of_kind(samples, PROBABILITY).slice(row, 1)
        return {c.removeprefix(PROBABILITY): round(float(there[c][0]), 6) for c in there.columns}

    def _event(self, samples: Table, first: int, last: int, row: int) -> Event:
        probability = self._probability(samples, row)
        fault = max(probability, key=lambda f: probability[f])
        ended = last < samples.height - 1
        channel = _sensor(samples, fault, row)
        return Event(
            t_start=onset(samples, first, fault, channel),
            t_end=float(samples[TIME][last]) if ended else None,
            kind=fault,
            channel=channel
            or PAIR.join(self.channels[f] for f in fault.split(PAIR) if f in self.channels)
            or None,
            confidence=probability[fault],
            source="dynoscope",
        )

    def _same_as(self, fault: str) -> list[str]:
        """The pairs that look like a single fault."""
        three = [group for group in self.alike if fault in group and len(group) == 3]
        return [PAIR.join(sorted({*group} - {fault})) for group in three]

    def _magnitude(self, samples: Table, fault: str, row: int, of: str = "") -> Magnitude | None:
        """The size of ``fault``, or of one of the two in it, at a row, where the isolation estimates it."""
        column = fault + OF + of if of else fault
        if SIZE + column not in samples.columns:
            return None
        value, sd = samples.select([SIZE + column, SIZE_SD + column]).slice(row, 1).row(0)
        if value is None or np.isnan(value):  # of a pair that only looks like the one that was found
            return None
        return Magnitude(
            value=float(value), sd=sd, unit=self.units.get(of or fault, self.units.get(column, "1"))
        )

    def _magnitudes(self, samples: Table, pair: str, row: int) -> dict[str, Magnitude]:
        """The sizes of two faults at once."""
        found = {f: self._magnitude(samples, pair, row, f) for f in pair.split(PAIR) if f != pair}
        return {f: size for f, size in found.items() if size is not None}


def _sensor(samples: Table, fault: str, row: int) -> str | None:
    """The sensor that a fault which several can have is most evident of at a row; None for other faults."""
    there = _of_kind(samples, SENSOR + fault + OF).slice(row, 1)
    names = there.columns
    return max(names, key=lambda c: there[c][0]).removeprefix(SENSOR + fault + OF) if names else None


def _strongest(samples: Table, first: int, last: int) -> tuple[float, int]:
    """The largest evidence for a fault in an event, and the event's last row with half of it: at the very end
    an alarm may have begun anew, with nothing known yet."""
    names = [c for c in samples.columns if c.startswith(EVIDENCE) and c != EVIDENCE + UNKNOWN]
    names = names or [STATISTIC]  # no fault is supposed
    asked = samples.select([*names, DETECTION])
    evidence = np.empty(last - first + 1)
    for k in range(0, evidence.size, ROWS):
        part = asked.slice(first + k, min(ROWS, evidence.size - k))
        known = part.select(pl.max_horizontal(names)).to_series().cast(pl.Float64).fill_nan(None)
        on = part[DETECTION].to_numpy() > 0
        evidence[k : k + ROWS] = np.where(on, known.fill_null(0.0).to_numpy(), -np.inf)
    largest = float(np.max(evidence))
    return largest, first + int(np.flatnonzero(evidence >= min(0.5 * largest, largest))[-1])


def detectable(samples: Table) -> dict[str, float | None] | None:
    """Smallest size of each fault that the log would have shown at 95 %; None where it would have shown
    none."""
    last = _of_kind(samples, DETECTABLE).slice(max(samples.height - 1, 0), 1).to_dicts()
    found = {
        c.removeprefix(DETECTABLE): None if x is None or not np.isfinite(x) else float(f"{x:.3g}")
        for row in last
        for c, x in row.items()
    }
    return found or None


def onset(samples: Table, first: int, fault: str = "", sensor: str | None = None) -> float:
    """When the ``fault`` (of ``sensor``) began that was detected at row ``first``, in s on the log's clock.

    The change point k that maximises the likelihood of a shift of the means of residuals or indicators from
    row k on, with e = z sigma their distance from the healthy value, ``sum_r (sum_{i >= k} e_i / sigma_i^2)^2
    / (2 sum_{i >= k} 1 / sigma_i^2)``, over the last 600 s before the detection; samples up to 30 s after it
    count as evidence. A sensor that does not move or scatters began to when the evidence for it did, where
    that is what raised the alarm.
    """
    time = samples[TIME].to_numpy()
    evident = SENSOR + fault + OF + (sensor or "")
    if evident in samples.columns and SIZE + fault + OF + (sensor or "") not in samples.columns:
        there = _array(samples, evident)[: first + 1] > 0
        if there[-1]:
            return float(time[np.flatnonzero(~there)[-1] + 1 if not there.all() else 0])
    a = int(np.searchsorted(time, time[first] - ONSET_BACK_S))
    b = int(np.searchsorted(time, time[first] + ONSET_AFTER_S, side="right"))
    shifts = [c for c in samples.columns if c.startswith(Z)]
    part = samples.select([*shifts, *(SIGMA + c.removeprefix(Z) for c in shifts)]).slice(a, b - a)
    gain = np.zeros(first - a + 1)
    for c in shifts:
        sigma = _array(part, SIGMA + c.removeprefix(Z))
        e = _array(part, c) * sigma
        weight = np.where(np.isfinite(e), 1 / sigma**2, 0.0)
        S0 = np.cumsum(weight[::-1])[::-1]
        S1 = np.cumsum((weight * np.nan_to_num(e))[::-1])[::-1]
        gain += (S1**2 / np.maximum(2 * S0, 1e-12))[: len(gain)]
    return float(time[a + int(np.argmax(gain))]) + 0.0  # a log may begin at -0.0


def usable_seconds(samples: Table) -> float:
    """Seconds of samples that say something: every residual or indicator known, and at rest (gate at least
    1/2)."""
    if samples.height < 2:
        return 0.0
    time = samples[TIME].to_numpy()
    step = np.diff(time, prepend=time[0])
    step = np.minimum(step, max(1.0, 1.5 * float(np.median(step))))  # a gap says nothing
    known = np.ones(samples.height, dtype=bool)
    for c in samples.columns:
        if c.startswith(Z):
            known &= np.isfinite(_array(samples, c))
    if GATE in samples.columns:
        known &= _array(samples, GATE) >= 0.5
    return float(step[known].sum())


def residual_statistics(samples: Table) -> dict[str, dict[str, float | None]]:
    """Per residual or indicator: mean distance from the healthy value, root mean square of z, share of
    samples beyond 3 sigma; and the share in domain, where there is one."""
    out: dict[str, dict[str, float | None]] = {}
    for c in samples.columns:
        if c.startswith(Z):
            z = _array(samples, c)
            e = z * _array(samples, SIGMA + c.removeprefix(Z))
            z = z[np.isfinite(z)]
            known = bool(z.size)
            out[c.removeprefix(Z)] = {
                "mean": float(np.nanmean(e)) if known else None,
                "z_rms": float(np.sqrt(np.mean(z**2))) if known else None,
                "beyond_3_sigma": float(np.mean(np.abs(z) > 3)) if known else None,
            }
    if IN_DOMAIN not in samples.columns:
        return out
    in_domain = samples[IN_DOMAIN].mean() if samples.height else None
    return {**out, IN_DOMAIN: {"share": float(in_domain) if in_domain is not None else None}}  # type: ignore[arg-type]


def _of_kind(samples: Table, kind: str) -> Table:
    return samples.select([c for c in samples.columns if c.startswith(kind)])


def _array(samples: Table, column: str) -> NDArray[np.float64]:
    return samples[column].cast(pl.Float64).fill_null(float("nan")).to_numpy()
