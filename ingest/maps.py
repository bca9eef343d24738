"""Name maps: which channel of a source is which signal, in which unit.

A map is a TOML file::

    vehicle = "bench 4"

    [time]
    source = "Zeit"
    unit = "ms"

    [signals.p_Bst]
    source = ["Intercooler_pressure", "p_ic*"]   # exact name first, else glob; the first that is there
    unit = "Pa"                                  # unit of ``scale * source + offset``

Optional per signal: ``scale``, ``offset``, ``kind``, ``resample``. A canonical signal is then converted to
its canonical unit; without ``unit`` the file's own unit counts.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from math import isfinite
from pathlib import Path
from typing import Any, get_args

import polars as pl

from ingest.errors import LogError, MapError, UnitError, did_you_mean
from ingest.log import TIME, Group, Kind, Log, Resample, Signal
from ingest.units import CANONICAL, conversion, find_unit

UNIT_ASSUMED = "unit assumed"
UNIT_FROM_MAP = "unit from map"
UNIT_UNKNOWN = "unit unknown"


@dataclass(frozen=True, kw_only=True)
class SignalMap:
    """One signal of a map; ``source`` lists exact names or globs, the first that is there counts."""

    source: tuple[str, ...]
    unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0
    kind: Kind | None = None
    resample: Resample | None = None


@dataclass(frozen=True, kw_only=True)
class TimeMap:
    """Which column is time (empty: known by its name), and its unit (None: the file's, else s).

    ``rate``: rows per second of a table without a time column.
    """

    source: tuple[str, ...] = ()
    unit: str | None = None
    rate: float | None = None


@dataclass(frozen=True, kw_only=True)
class NameMap:
    """A whole map; ``origin`` names it in messages."""

    signals: Mapping[str, SignalMap] = field(default_factory=dict)
    time: TimeMap = TimeMap()
    vehicle: str | None = None
    dbc: tuple[Path, ...] = ()
    origin: str = "map"


def match(sources: Iterable[str], names: Iterable[str]) -> list[str]:
    """The names that the first fitting source means: exactly, else as a glob.

    >>> match(["rpm", "n_*"], ["n_Eng", "t"])
    ['n_Eng']
    """
    known = list(names)
    for source in sources:
        found = [source] if source in known else [n for n in known if fnmatchcase(n, source)]
        if found:
            return found
    return []


def load_map(path: str | Path) -> NameMap:
    """Reads a map.

    Raises:
        MapError: the file cannot be read, or holds mistakes; all of them are listed.
    """
    path = Path(path)
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise MapError(f"map {path} cannot be read: {error}") from error
    mistakes = _unknown("the map", table, ("signals", "time", "vehicle", "dbc"))
    vehicle = _typed("vehicle", table.get("vehicle"), str, mistakes)
    time = _time_map(_typed("[time]", table.get("time"), dict, mistakes) or {}, mistakes)
    entries = _typed("[signals]", table.get("signals"), dict, mistakes) or {}
    signals = {name: _signal_map(name, entry, mistakes) for name, entry in entries.items()}
    dbc = _sources("dbc", table["dbc"], mistakes) if "dbc" in table else ()
    if mistakes:
        raise MapError(f"map {path}:" + "".join(f"\n  {m}" for m in mistakes))
    databases = tuple(path.parent / d for d in dbc)
    return NameMap(signals=signals, time=time, vehicle=vehicle, dbc=databases, origin=str(path))


def _unknown(where: str, table: Mapping[str, Any], known: tuple[str, ...]) -> list[str]:
    return [f"{where} has no setting {k!r}; {did_you_mean(k, known)}" for k in table if k not in known]


def _typed(where: str, value: Any, wanted: type, mistakes: list[str]) -> Any:
    fits = isinstance(value, (int, float) if wanted is float else wanted) and not isinstance(value, bool)
    if value is None or (fits and (wanted is not float or isfinite(value))):
        return value
    word = {str: "text", float: "a finite number", dict: "a table"}[wanted]
    mistakes.append(f"{where} is {value!r}; expected {word}")
    return None


def _sources(where: str, value: Any, mistakes: list[str]) -> tuple[str, ...]:
    names = [value] if isinstance(value, str) else value
    if isinstance(names, list) and names and all(isinstance(n, str) and n for n in names):
        return tuple(names)
    mistakes.append(f"{where} is {value!r}; expected a name, or a list of alternatives")
    return ()


def _time_map(table: Mapping[str, Any], mistakes: list[str]) -> TimeMap:
    mistakes += _unknown("[time]", table, ("source", "unit", "rate"))
    rate = _typed("[time] rate", table.get("rate"), float, mistakes)
    if rate is not None and rate <= 0:
        mistakes.append(f"[time] rate is {rate}; expected rows per second, above 0")
    unit = _typed("[time] unit", table.get("unit"), str, mistakes)
    if unit is not None:
        _check_unit("[time]", unit, "s", mistakes)
    source = _sources("[time] source", table["source"], mistakes) if "source" in table else ()
    return TimeMap(source=source, unit=unit, rate=None if rate is None else float(rate))


def _signal_map(name: str, table: Any, mistakes: list[str]) -> SignalMap:
    where = f"[signals.{name}]"
    if not isinstance(table, dict):
        mistakes.append(f'{where} is {table!r}; expected a table such as {{source = "...", unit = "..."}}')
        return SignalMap(source=())
    mistakes += _unknown(where, table, ("source", "unit", "scale", "offset", "kind", "resample"))
    near = {c.casefold(): c for c in CANONICAL}.get(name.casefold(), name)
    if near != name:
        mistakes.append(f"{where}: did you mean {near}? A signal's name is case-sensitive")
    unit = _typed(f"{where} unit", table.get("unit"), str, mistakes)
    if unit is not None and name in CANONICAL:
        _check_unit(where, unit, CANONICAL[name], mistakes)
    numbers = {
        k: _typed(f"{where} {k}", table[k], float, mistakes) for k in ("scale", "offset") if k in table
    }
    if numbers.get("scale") == 0:
        mistakes.append(f"{where} scale is 0; expected a number that keeps the signal")
    words: dict[str, Any] = {}
    for key, allowed in (("kind", get_args(Kind)), ("resample", get_args(Resample))):
        if key in table and table[key] not in allowed:
            mistakes.append(f"{where} {key} is {table[key]!r}; {did_you_mean(str(table[key]), allowed)}")
        words[key] = table.get(key)
    factors: dict[str, Any] = {k: float(v) for k, v in numbers.items() if v is not None}
    return SignalMap(
        source=_sources(f"{where} source", table.get("source"), mistakes), unit=unit, **factors, **words
    )


def _check_unit(where: str, unit: str, target: str, mistakes: list[str]) -> None:
    try:
        conversion(unit, target)
    except UnitError as error:
        mistakes.append(f"{where}: {error}")


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
            columns.append(_converted(log.name, group.frame[channel], scale, offset).alias(target))
            signals[target] = new
        groups[key] = Group(group.name, pl.DataFrame(columns), signals)
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
        kind=entry.kind or signal.kind,
        resample=entry.resample or signal.resample,
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
