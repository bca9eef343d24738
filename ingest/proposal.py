"""A first map for an unknown log: which channels could be which signals, by name and unit.

It is proposed, never applied: a user reads it, edits it, and gives it back with ``--map``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping

import polars as pl

from ingest.log import Log, Signal
from ingest.units import CANONICAL, conversion, find_unit

_WORDS: Mapping[str, frozenset[str]] = {
    "boost": frozenset(
        {"boost", "bst", "ic", "intercooler", "charge", "lade", "ladedruck", "p2", "p22", "bo"}
    ),
    "intake": frozenset({"intake", "int", "im", "manifold", "saugrohr", "map", "inlet", "man", "einlass"}),
    "exhaust": frozenset({"exhaust", "exh", "em", "turbine", "abgas", "p3", "t3", "egt", "auslass"}),
    "ambient": frozenset({"ambient", "amb", "umgebung", "baro", "barometric", "atm", "air0", "env"}),
    "pressure": frozenset({"pressure", "p", "press", "druck", "ladedruck", "map"}),
    "temperature": frozenset({"temperature", "temp", "t", "temperatur"}),
    "air": frozenset({"air", "maf", "hfm", "luft", "luftmasse", "mair"}),
    "flow": frozenset({"flow", "maf", "hfm", "w", "mdot", "massenstrom", "luftmasse"}),
    "fuel": frozenset({"fuel", "inj", "injected", "injection", "kraftstoff", "einspritzmenge"}),
    "engine": frozenset({"engine", "eng", "motor", "nmot", "rpm", "crank", "crankshaft", "drehzahl"}),
    "speed": frozenset({"speed", "n", "rpm", "nmot", "drehzahl", "omega"}),
    "turbo": frozenset({"turbo", "tc", "turbocharger", "trb", "lader"}),
    "throttle": frozenset({"throttle", "thr", "tps", "thv", "drossel", "drosselklappe", "alpha"}),
    "egr": frozenset({"egr", "agr"}),
    "vnt": frozenset({"vnt", "vgt", "vtg"}),
    "wastegate": frozenset({"wastegate", "wg", "waste"}),
    "lambda": frozenset({"lambda", "lam", "afr", "lsu"}),
    "vehicle": frozenset({"vehicle", "veh", "velocity", "fahrzeug", "geschwindigkeit", "v", "vfzg"}),
}
_NEEDED: Mapping[str, tuple[str, ...]] = {
    "p_Bst": ("boost", "pressure"), "p_Int": ("intake", "pressure"), "p_Exh": ("exhaust", "pressure"),
    "p_Amb": ("ambient", "pressure"), "T_Bst": ("boost", "temperature"), "T_Int": ("intake", "temperature"),
    "T_Exh": ("exhaust", "temperature"), "T_Amb": ("ambient", "temperature"), "W_HFM": ("air", "flow"),
    "W_Fuel": ("fuel", "flow"), "m_Fuel": ("fuel",), "n_Eng": ("engine", "speed"),
    "n_Turb": ("turbo", "speed"), "theta_Thr": ("throttle",), "u_Egr": ("egr",), "u_Vnt": ("vnt",),
    "u_Wg": ("wastegate",), "lambda": ("lambda",), "v_Veh": ("vehicle",),
}  # fmt: skip
"""What the name of a channel must say for each signal."""
_PLAUSIBLE: Mapping[str, tuple[tuple[str, ...], float, float]] = {
    "kPa": (("kPa", "bar", "mbar", "Pa"), 15.0, 500.0),
    "K": (("K", "°C"), 230.0, 1400.0),
    "g/s": (("g/s", "kg/h", "kg/s"), 0.5, 1000.0),
    "rpm": (("rpm", "rad/s", "1/s"), 400.0, 300_000.0),
    "%": (("%", "0..1"), 1.5, 100.0),
}
"""Usual units of signals with a canonical unit, and where their middle value lies in that."""
_NOT = frozenset(
    {"set", "setpoint", "soll", "des", "desired", "target", "cmd", "error", "dev", "ref", "demand"}
)


def propose(log: Log) -> dict[str, str]:
    """Signal -> channel, where both the name and the unit (if there is one) fit; each channel once.

    >>> from ingest.log import Group
    >>> import polars as pl
    >>> frame = pl.DataFrame({"time": [0.0], "Intercooler_pressure": [1e5], "engine_speed": [90.0]})
    >>> propose(Log("x", {"g": Group("g", frame)}))
    {'p_Bst': 'Intercooler_pressure', 'n_Eng': 'engine_speed'}
    """
    channels = {n: s for n, s in log.signals.items() if n not in CANONICAL}
    scores = sorted(
        (
            (-score, signal, name)
            for name, s in channels.items()
            for signal in _NEEDED
            if (score := _score(signal, s))
        ),
        key=lambda found: (found[0], list(_NEEDED).index(found[1]), found[2]),
    )
    chosen: dict[str, str] = {}
    for _, signal, name in scores:
        if signal not in chosen and name not in chosen.values() and signal not in log.signals:
            chosen[signal] = name
    return {s: chosen[s] for s in _NEEDED if s in chosen}


def as_toml(log: Log, chosen: Mapping[str, str]) -> str:
    """The proposal as a map to save and edit; what it is not sure of is said in comments."""
    lines = [
        f"# Proposed for {_text(log.name)} by the names, units and values of its channels. Check every line."
    ]
    signals = log.signals
    for signal, channel in chosen.items():
        known = signals[channel]
        lines += ["", f"[signals.{_key(signal)}]", f"source = {_text(channel)}"]
        if known.unit is None:
            unit = _guess_unit(signal, log.group_of(channel).frame[channel])
            lines.append(f"unit = {_text(unit)}  # a guess by its values: the file gives no unit")
        else:
            lines.append(f"# unit = {_text(known.unit)}  # the file's own")
    left = [n for n in signals if n not in chosen.values() and n not in CANONICAL]
    if left:
        lines += ["", "# Channels that no signal was proposed for:"]
        lines += [f"#   {_text(n)}{f' in {_text(u)}' if (u := signals[n].unit) else ''}" for n in left]
    return "\n".join(lines) + "\n"


def _guess_unit(signal: str, values: pl.Series) -> str:
    """The first usual unit in which the middle value is plausible, else the canonical one."""
    canonical = CANONICAL[signal]
    usual, low, high = _PLAUSIBLE.get(canonical, ((), 0.0, 0.0))
    middle = values.median() if values.dtype.is_numeric() else None
    for unit in usual:
        scale, offset = conversion(unit, canonical)
        if isinstance(middle, float) and low <= scale * middle + offset <= high:
            return unit
    return canonical


def _score(signal: str, channel: Signal) -> int:
    """How well a channel fits: 0 not at all; a point for each thing its name says, one for a fitting unit."""
    words = _words(channel.source_name or channel.name)
    unit = find_unit(channel.unit) if channel.unit else None
    fits = unit is not None and unit.dimension == find_unit(CANONICAL[signal]).dimension  # type: ignore[union-attr]
    if words & _NOT or (unit is not None and not fits):
        return 0
    needed = _NEEDED[signal]
    said = [bool(words & _WORDS[n]) for n in needed]
    shown = said[0] and (all(said) or (fits and len(needed) > 1))
    return sum(said) + fits if shown else 0


def _words(name: str) -> set[str]:
    return {w.lower() for w in re.findall(r"[A-ZÄÖÜ]?[a-zäöüß]+\d*|[A-ZÄÖÜ]+\d*(?![a-z])", name)}


def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False)


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _text(name)
