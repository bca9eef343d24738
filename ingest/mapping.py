"""Applying a name map: channels get their signal's name, canonical signals their canonical unit."""

from __future__ import annotations

import re
from dataclasses import replace

import polars as pl

from ingest.errors import LogError, UnitError, did_you_mean
from ingest.log import TIME, Group, Kind, Log, Signal
from ingest.maps import NameMap, SignalMap, match
from ingest.units import CANONICAL, conversion, find_unit

UNIT_ASSUMED = "unit assumed"
UNIT_FROM_MAP = "unit from map"
UNIT_UNKNOWN = "unit unknown"
INVALID = "values outside the map's valid range are missing"
_STATES = {
    "gear", "state", "status", "mode", "flag", "switch", "enable", "enabled", "active", "phase", "stage",
    "fault", "error", "dtc", "bit", "ready", "request",
}  # fmt: skip
_COUNTERS = {"counter", "count", "cnt", "ctr", "zaehler", "zähler", "index", "idx"}


def apply_map(log: Log, names: NameMap) -> Log:
    """Gives mapped channels their signal's name and canonical signals their canonical unit.

    Applying a map twice changes nothing. A signal whose sources are not in the log is told in the fact
    ``notes``.

    Raises:
        LogError: a source fits several channels, one channel or signal is meant twice, or text would have to
            be converted.
        UnitError: the unit of a canonical signal cannot be converted.
    """
    targets, notes = _resolve(log, names)
    groups = {}
    for key, group in log.groups.items():
        columns, signals = [group.frame[TIME]], {}
        for channel, signal in group.signals.items():
            target = targets.get(channel, channel)
            entry = names.signals.get(target) if channel in targets else None
            try:
                new, scale, offset = _mapped(signal, target, entry)
            except UnitError as error:
                raise UnitError(
                    f"log {log.name!r}, channel {channel!r} (signal {target}): {error}; "
                    f"a map can give another: [signals.{target}] source = {channel!r}, unit = ..."
                ) from error
            column = _converted(log.name, group.frame[channel], scale, offset).alias(target)
            if entry is not None and entry.valid is not None:
                column, new = _within(column, new, entry.valid)
            columns.append(column)
            signals[target] = _with_kind(new, column.dtype, entry)
        same = signals == dict(group.signals)
        groups[key] = group if same else Group(group.name, pl.DataFrame(columns), signals)
    facts = {**log.facts, **({} if names.vehicle is None else {"vehicle": names.vehicle})}
    if notes:
        facts["notes"] = list(dict.fromkeys([*facts.get("notes", ()), *notes]))
    return replace(log, groups=groups, facts=facts)


def _resolve(log: Log, names: NameMap) -> tuple[dict[str, str], list[str]]:
    """Channel -> signal for every entry whose source is there, and a note for every other."""
    by_source = {s.source_name: n for n, s in log.signals.items() if s.source_name is not None}
    targets: dict[str, str] = {}
    notes = []
    for target, entry in names.signals.items():
        found = match(entry.source, log.signals) or [by_source[n] for n in match(entry.source, by_source)]
        where = f"log {log.name!r}, {names.origin}, [signals.{target}]"
        if len(found) > 1:
            raise LogError(
                f"{where}: source {entry.source} fits {len(found)} channels {found}; name one of them"
            )
        if not found and target not in log.signals:
            hint = did_you_mean(entry.source[0], log.signals)
            notes.append(f"map: no channel {' or '.join(entry.source)} for {target}; {hint}")
        for channel in found:
            if channel in targets:
                raise LogError(f"{where}: channel {channel!r} is already the source of {targets[channel]}")
            targets[channel] = target
    for channel, target in targets.items():
        if target != channel and target in log.signals and targets.get(target, target) == target:
            raise LogError(
                f"log {log.name!r}, {names.origin}: {target} would be there twice, from {channel!r} "
                f"and under its own name; let one [signals.{target}] or another name take the second"
            )
    return targets, notes


def _mapped(signal: Signal, target: str, entry: SignalMap | None) -> tuple[Signal, float, float]:
    """The signal as it will be, and the scale and offset that bring its values there."""
    now = (signal.unit, signal.scale, signal.offset)
    done = entry is not None and signal.name == target and now == _step(target, entry, signal.source_unit)
    entry = entry or SignalMap(source=())
    unit, scale, offset = (signal.unit, 1.0, 0.0) if done else _step(target, entry, signal.unit)
    given = entry.unit or signal.unit
    touched = (target, unit, scale, offset) != (signal.name, given, 1.0, 0.0)
    flags = {
        UNIT_ASSUMED: given is None and unit is not None,
        UNIT_FROM_MAP: entry.unit is not None,
        UNIT_UNKNOWN: unit is not None and find_unit(unit) is None,
    }
    new = replace(
        signal,
        name=target,
        unit=unit,
        scale=scale * signal.scale,
        offset=scale * signal.offset + offset,
        flags=tuple(dict.fromkeys([*signal.flags, *(f for f, holds in flags.items() if holds)])),
    )
    if touched:
        new = replace(
            new, source_name=signal.source_name or signal.name, source_unit=signal.source_unit or given
        )
    return new, scale, offset


def _step(target: str, entry: SignalMap, unit: str | None) -> tuple[str | None, float, float]:
    """Unit after mapping, and ``new = scale * old + offset`` for values whose own unit is ``unit``."""
    unit = entry.unit or unit
    canonical = CANONICAL.get(target, unit)
    scale, offset = (1.0, 0.0) if unit is None or canonical == unit else conversion(unit, str(canonical))
    return canonical, scale * entry.scale, scale * entry.offset + offset


def _converted(log: str, values: pl.Series, scale: float, offset: float) -> pl.Series:
    if (scale, offset) == (1.0, 0.0):
        return values
    if not (values.dtype.is_numeric() or values.dtype == pl.Boolean):
        example = values.drop_nulls().head(1).to_list()
        raise LogError(f"log {log!r}, channel {values.name!r} holds text such as {example}; expected numbers")
    exact = values.cast(pl.Float64) * scale + offset
    return exact.cast(pl.Float32) if values.dtype == pl.Float32 else exact


def _within(values: pl.Series, signal: Signal, valid: tuple[float, float]) -> tuple[pl.Series, Signal]:
    outside = ~values.is_between(*valid).fill_null(True)
    if not outside.any():
        return values, signal
    return values.set(outside, None), replace(signal, flags=tuple(dict.fromkeys((*signal.flags, INVALID))))


def _with_kind(signal: Signal, dtype: pl.DataType, entry: SignalMap | None) -> Signal:
    """The kind the map says, else the one its type and name suggest where nothing else is known."""
    kind = (entry.kind if entry else None) or (
        kind_of(signal, dtype) if signal.kind == "continuous" else signal.kind
    )
    held = "hold" if kind != "continuous" and signal.resample == "linear" else signal.resample
    return replace(signal, kind=kind, resample=(entry.resample if entry else None) or held)


def kind_of(signal: Signal, dtype: pl.DataType) -> Kind:
    """What a signal without unit is: words and truth values are states, and so are whole numbers.

    >>> kind_of(Signal(name="ActGear"), pl.Float64()), kind_of(Signal(name="p_Bst", unit="kPa"), pl.Int16())
    ('state', 'continuous')
    """
    if dtype in (pl.String, pl.Boolean):
        return "state"
    if signal.name in CANONICAL or (signal.unit and find_unit(signal.unit) != find_unit("-")):
        return "continuous"
    words = {w.lower() for w in re.findall(r"[A-Z]*[a-zäöü]+|[A-Z]+", signal.source_name or signal.name)}
    if words & _COUNTERS:
        return "counter"
    return "state" if words & _STATES or dtype.is_integer() else "continuous"
