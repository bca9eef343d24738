"""Units as benches write them, and the affine way from one to another.

Every spelling names a dimension and ``base = factor * value + offset`` in that dimension's base unit. The
table is our own because general unit libraries read several of these words wrongly: ``rpm`` is an angular
rate, ``U/min`` an enzyme unit, ``C`` a charge. Gauge pressure is a dimension of its own: without the ambient
pressure it cannot be made absolute.
"""

from __future__ import annotations

import math
import re
import unicodedata
from functools import cache
from importlib.util import find_spec
from typing import Any, NamedTuple

from ingest.errors import UnitError, did_you_mean

CANONICAL = {
    **dict.fromkeys(("p_Bst", "p_Int", "p_Exh", "p_Amb"), "kPa"),
    **dict.fromkeys(("T_Bst", "T_Int", "T_Amb", "T_Exh"), "K"),
    **dict.fromkeys(("W_HFM", "W_Fuel"), "g/s"),
    "m_Fuel": "mg/stroke",
    **dict.fromkeys(("n_Eng", "n_Turb"), "rpm"),
    **dict.fromkeys(("theta_Thr", "u_Egr", "u_Vnt", "u_Wg"), "%"),
    "lambda": "1",
    "v_Veh": "km/h",
    **dict.fromkeys(("e_a", "theta_ang"), "V"),
}
"""Unit of each canonical signal."""


class Unit(NamedTuple):
    """``base = factor * value + offset`` in the base unit of ``dimension``."""

    dimension: str
    factor: float
    offset: float = 0.0


_PRESSURE = {
    "Pa": 1e-3, "hPa": 0.1, "mbar": 0.1, "kPa": 1.0, "bar": 100.0, "MPa": 1e3, "mPa": 1e-6,
    "psi": 6.894757293168, "atm": 101.325, "at": 98.0665, "mmHg": 0.133322387415, "Torr": 101.325 / 760,
    "inHg": 3.386388640341, "mmH2O": 9.80665e-3, "mmWS": 9.80665e-3, "inH2O": 0.2490889083333,
}  # fmt: skip
_UNITS: dict[str, dict[str, float]] = {
    "absolute pressure": _PRESSURE,
    "rotational speed": {
        "rpm": 1.0, "U/min": 1.0, "1/min": 1.0, "min-1": 1.0, "/min": 1.0, "rev/min": 1.0, "r/min": 1.0,
        "Upm": 1.0, "krpm": 1e3, "U/s": 60.0, "rev/s": 60.0, "rps": 60.0, "1/s": 60.0, "s-1": 60.0,
        "Hz": 60.0, "rad/s": 30.0 / math.pi, "deg/s": 1.0 / 6.0,
    },
    "mass flow": {
        "g/s": 1.0, "kg/s": 1e3, "mg/s": 1e-3, "kg/h": 1.0 / 3.6, "g/h": 1.0 / 3600.0, "kg/min": 1e3 / 60.0,
        "g/min": 1.0 / 60.0, "t/h": 1e3 / 3.6, "lb/min": 453.59237 / 60.0, "lb/h": 453.59237 / 3600.0,
    },
    "mass per stroke": {
        **dict.fromkeys(("mg/stroke", "mg/stk", "mg/str", "mg/hub", "mg/strk", "mg/inj", "mg/ASP"), 1.0),
        **dict.fromkeys(("g/stroke", "g/stk", "g/hub"), 1e3), **dict.fromkeys(("kg/stroke", "kg/stk"), 1e6),
    },
    "ratio": {
        **dict.fromkeys(("1", "-", "fraction", "frac", "ratio", "0..1", "0-1", "lambda"), 1.0),
        **dict.fromkeys(("%", "percent", "pct", "prozent"), 0.01), "‰": 1e-3, "ppm": 1e-6,
    },
    "velocity": {
        "km/h": 1.0, "kmh": 1.0, "kph": 1.0, "kmph": 1.0, "m/s": 3.6, "mph": 1.609344,
        "mi/h": 1.609344, "ft/s": 1.09728, "kn": 1.852,
    },
    "voltage": {"V": 1.0, "mV": 1e-3, "uV": 1e-6, "kV": 1e3, "Volt": 1.0},
    "current": {"A": 1.0, "mA": 1e-3},
    "time": {
        "s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3, "msec": 1e-3, "us": 1e-6, "ns": 1e-9,
        "min": 60.0, "minute": 60.0, "minutes": 60.0, "h": 3600.0, "hr": 3600.0, "hour": 3600.0,
        "hours": 3600.0,
    },
    "torque": {"Nm": 1.0, "kNm": 1e3, "mNm": 1e-3, "ft-lb": 1.3558179483314, "lbf.ft": 1.3558179483314},
    "power": {"kW": 1.0, "W": 1e-3, "PS": 0.73549875, "hp": 0.745699871582},
    "angle": {
        "deg": 1.0, "rad": 180.0 / math.pi,
        **dict.fromkeys(("degCA", "degCrA", "degKW", "CAD", "CA"), 1.0),
    },
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "km": 1e3},
    "mass": {"g": 1.0, "kg": 1e3, "mg": 1e-3},
    "acceleration": {"m/s2": 1.0, "m/s^2": 1.0, "g0": 9.80665},
    "concentration": {"mg/m3": 1.0},
    "resistance": {"Ohm": 1.0, "kOhm": 1e3},
    "truth value": {"bool": 1.0},
}  # fmt: skip
_TEMPERATURE = {
    **dict.fromkeys(("K", "Kelvin", "degK"), Unit("temperature", 1.0)),
    **dict.fromkeys(("degC", "C", "Celsius", "gradC", "grdC", "Cel"), Unit("temperature", 1.0, 273.15)),
    **dict.fromkeys(("degF", "F", "Fahrenheit"), Unit("temperature", 5.0 / 9.0, 273.15 - 160.0 / 9.0)),
}
_TABLE = {w: Unit(dim, f) for dim, words in _UNITS.items() for w, f in words.items()} | _TEMPERATURE
_BY_CASE = {w.casefold(): {u for v, u in _TABLE.items() if v.casefold() == w.casefold()} for w in _TABLE}


def _look_up(word: str) -> Unit | None:
    meanings = {_TABLE[word]} if word in _TABLE else _BY_CASE.get(word.casefold(), set())
    return next(iter(meanings)) if len(meanings) == 1 else None


def find_unit(text: str) -> Unit | None:
    """The unit a spelling means, None if it is not known.

    Spaces, brackets around the whole, ``*``, ``·`` and ``^`` do not matter; case matters only where it
    changes the meaning. A pressure may end in ``abs``, ``a`` (absolute) or ``rel``, ``g``, ``gauge``.

    >>> find_unit("[ U/min ]") == find_unit("min^-1") == find_unit("RPM")
    True
    >>> find_unit("mPa").factor, find_unit("MPa").factor, find_unit("furlong")
    (1e-06, 1000.0, None)
    >>> find_unit("bar_g").dimension
    'gauge pressure'
    """
    plain = unicodedata.normalize("NFKC", text.strip().replace("º", "°").replace("⋅", "·"))
    plain = re.sub(r"^[\[(](.*)[\])]$", r"\1", plain)
    plain = re.sub(r"[−–]", "-", plain).replace("μ", "u").replace("Ω", "Ohm")
    plain = re.sub(r"[\s*·^]", "", plain.replace("°", "deg"))
    unit = _look_up(plain)
    kind = re.fullmatch(r"(\w+?)[_(]?(abs|a|rel|gauge|g)\)?", plain, re.IGNORECASE)
    if unit is None and kind and (bare := _look_up(kind[1])) and bare.dimension == "absolute pressure":
        return bare if kind[2][0] in "aA" else bare._replace(dimension="gauge pressure")
    return unit


def conversion(source_unit: str, target_unit: str) -> tuple[float, float]:
    """``(scale, offset)`` with ``target value = scale * source value + offset``.

    >>> conversion("hPa", "kPa"), conversion("°C", "K"), conversion("-", "%")
    ((0.1, 0.0), (1.0, 273.15), (100.0, 0.0))

    Raises:
        UnitError: a unit is not known, or the two measure different things.
    """
    source, target = find_unit(source_unit), find_unit(target_unit)
    if target is None:
        raise UnitError(f"unit {target_unit!r} is not known; {did_you_mean(target_unit, _TABLE)}")
    if source is None and (found := _by_pint(source_unit, target)):
        scale, offset = found
        return scale / target.factor, (offset - target.offset) / target.factor
    if source is None:
        fitting = [word for word, unit in _TABLE.items() if unit.dimension == target.dimension]
        raise UnitError(
            f"unit {source_unit!r} is not known, to be converted to {target_unit!r}; "
            f"{did_you_mean(source_unit, fitting)}"
        )
    if source.dimension != target.dimension:
        ambient = "; in a map, give the absolute unit and the ambient pressure in it as `offset`"
        gauge = {source.dimension, target.dimension} == {"absolute pressure", "gauge pressure"}
        raise UnitError(
            f"unit {source_unit!r} is {source.dimension}, but {target_unit!r} is {target.dimension}"
            f"{ambient if gauge else ''}"
        )
    return source.factor / target.factor, (source.offset - target.offset) / target.factor


_PINT_BASE = {
    "absolute pressure": "kPa", "mass flow": "g/s", "velocity": "km/hour", "voltage": "V", "current": "A",
    "time": "s", "torque": "newton*meter", "power": "kW", "length": "m", "mass": "g",
    "acceleration": "m/s**2", "concentration": "mg/m**3", "resistance": "ohm",
}  # fmt: skip
"""Base units as pint writes them, of the dimensions in which it has been found right. Rotational speeds,
ratios and temperatures are not among them: there it takes one thing for another."""


@cache
def _by_pint(text: str, target: Unit) -> tuple[float, float] | None:
    """Scale and offset to the base unit of the target's dimension, of a unit that only pint knows."""
    if target.dimension not in _PINT_BASE or find_spec("pint") is None:
        return None
    import pint

    registry: Any = pint.UnitRegistry()
    try:
        low, high = (
            registry.Quantity(v, text).to(_PINT_BASE[target.dimension]).magnitude for v in (0.0, 1.0)
        )
    except Exception:  # its parser raises many kinds of error on words that are no units
        return None
    return float(high - low), float(low)
