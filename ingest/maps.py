"""Name maps: which channel of a source is which signal, in which unit.

A map is a TOML file::

    vehicle = "bench 4"

    [time]
    source = "Zeit"
    unit = "ms"

    [signals.p_Bst]
    source = ["Intercooler_pressure", "p_ic*"]   # exact name first, else glob; the first that is there
    unit = "Pa"                                  # unit of ``scale * source + offset``

Optional per signal: ``scale``, ``sign`` (1 or -1), ``offset``, ``valid`` (lowest and highest value, in the
unit the signal has in the end: others are taken as missing, and flagged), ``kind``, ``resample``. A canonical
signal is converted to its canonical unit; without ``unit`` the file's own unit counts. ``dbc = ["ecu.dbc"]``
names what decodes CAN frames, ``[time] rate = 10`` the rows per second of a table without a time column.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from math import isfinite
from pathlib import Path
from typing import Any, get_args

from ingest.errors import MapError, UnitError, did_you_mean
from ingest.log import Kind, Resample
from ingest.units import CANONICAL, conversion

_SETTINGS = ("source", "unit", "scale", "sign", "offset", "valid", "kind", "resample")


@dataclass(frozen=True, kw_only=True)
class SignalMap:
    """One signal of a map; ``source`` lists exact names or globs, the first that is there counts."""

    source: tuple[str, ...]
    unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0
    valid: tuple[float, float] | None = None
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
    mistakes += _unknown(where, table, _SETTINGS)
    near = {c.casefold(): c for c in CANONICAL}.get(name.casefold(), name)
    if near != name:
        mistakes.append(f"{where}: did you mean {near}? A signal's name is case-sensitive")
    unit = _typed(f"{where} unit", table.get("unit"), str, mistakes)
    if unit is not None and name in CANONICAL:
        _check_unit(where, unit, CANONICAL[name], mistakes)
    numbers = {k: _typed(f"{where} {k}", table.get(k), float, mistakes) for k in ("scale", "offset")}
    if numbers.get("scale") == 0:
        mistakes.append(f"{where} scale is 0; expected a number that keeps the signal")
    sign = table.get("sign", 1)
    if sign not in (1, -1) or isinstance(sign, bool):
        mistakes.append(f"{where} sign is {sign!r}; expected 1 or -1")
    valid = _range(where, table["valid"], mistakes) if "valid" in table else None
    words: dict[str, Any] = {}
    for key, allowed in (("kind", get_args(Kind)), ("resample", get_args(Resample))):
        if key in table and table[key] not in allowed:
            mistakes.append(f"{where} {key} is {table[key]!r}; {did_you_mean(str(table[key]), allowed)}")
        words[key] = table.get(key)
    scale, offset = (float(d if v is None else v) for v, d in zip(numbers.values(), (1.0, 0.0), strict=True))
    source = _sources(f"{where} source", table.get("source"), mistakes)
    factor = -scale if sign == -1 else scale
    return SignalMap(source=source, unit=unit, scale=factor, offset=offset, valid=valid, **words)


def _range(where: str, value: Any, mistakes: list[str]) -> tuple[float, float] | None:
    numbers = isinstance(value, list) and all(isinstance(v, int | float) and isfinite(v) for v in value)
    if numbers and len(value) == 2 and value[0] < value[1]:
        return float(value[0]), float(value[1])
    mistakes.append(f"{where} valid is {value!r}; expected [lowest, highest]")
    return None


def _check_unit(where: str, unit: str, target: str, mistakes: list[str]) -> None:
    try:
        conversion(unit, target)
    except UnitError as error:
        mistakes.append(f"{where}: {error}")
