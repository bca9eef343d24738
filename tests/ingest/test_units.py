from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ingest.errors import UnitError
from ingest.units import _TABLE, CANONICAL, conversion, find_unit

TRAPS = [  # source, target, value, the same in target: from the definitions of the units
    ("rpm", "rpm", 3000.0, 3000.0),
    ("U/min", "rpm", 3000.0, 3000.0),
    ("1/min", "rpm", 1.0, 1.0),
    ("min-1", "rpm", 1.0, 1.0),
    ("min⁻¹", "rpm", 1.0, 1.0),
    ("RPM", "rpm", 1.0, 1.0),
    ("rad/s", "rpm", 2 * math.pi, 60.0),
    ("Hz", "rpm", 50.0, 3000.0),
    ("degC", "K", 25.0, 298.15),
    ("°C", "K", -40.0, 233.15),
    ("C", "K", 0.0, 273.15),
    ("deg C", "K", 100.0, 373.15),
    ("Celsius", "K", 100.0, 373.15),
    ("degF", "K", 32.0, 273.15),
    ("°F", "K", 212.0, 373.15),
    ("Pa", "kPa", 101325.0, 101.325),
    ("hPa", "kPa", 1013.25, 101.325),
    ("mbar", "kPa", 1013.25, 101.325),
    ("bar", "kPa", 2.5, 250.0),
    ("bara", "kPa", 2.5, 250.0),
    ("kPa_abs", "kPa", 99.0, 99.0),
    ("kPa (abs)", "kPa", 99.0, 99.0),
    ("PSIA", "kPa", 14.6959487755, 101.325),
    ("MPa", "kPa", 0.1, 100.0),
    ("Torr", "kPa", 760.0, 101.325),
    ("kg/h", "g/s", 3.6, 1.0),
    ("kg/s", "g/s", 0.05, 50.0),
    ("KG/H", "g/s", 36.0, 10.0),
    ("mg/stk", "mg/stroke", 12.0, 12.0),
    ("mg/Hub", "mg/stroke", 12.0, 12.0),
    ("%", "%", 37.0, 37.0),
    ("-", "%", 0.37, 37.0),
    ("[0..1]", "%", 0.37, 37.0),
    ("fraction", "%", 0.37, 37.0),
    ("–", "1", 1.02, 1.02),
    ("m/s", "km/h", 10.0, 36.0),
    ("mph", "km/h", 1.0, 1.609344),
    ("kph", "km/h", 50.0, 50.0),
    ("ms", "s", 1500.0, 1.5),
    ("µs", "s", 1.0, 1e-6),
    ("mV", "V", 5000.0, 5.0),
    ("bar(g)", "barg", 1.2, 1.2),
    ("N·m", "Nm", 7.0, 7.0),
]


@pytest.mark.parametrize(("source", "target", "value", "expected"), TRAPS)
def test_conversion(source: str, target: str, value: float, expected: float) -> None:
    scale, offset = conversion(source, target)
    assert scale * value + offset == pytest.approx(expected, rel=1e-9)


@given(st.sampled_from(sorted(_TABLE)), st.sampled_from(sorted(_TABLE)), st.floats(-1e6, 1e6))
def test_there_and_back(a: str, b: str, value: float) -> None:
    if _TABLE[a].dimension != _TABLE[b].dimension:
        with pytest.raises(UnitError, match="is"):
            conversion(a, b)
        return
    (scale, offset), (back, shift) = conversion(a, b), conversion(b, a)
    assert back * (scale * value + offset) + shift == pytest.approx(value, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("word", sorted(_TABLE))
def test_every_word_of_the_table_is_found_as_itself(word: str) -> None:
    assert find_unit(word) == _TABLE[word] == find_unit(f" [{word}] ")


def test_case_decides_only_where_it_must() -> None:
    assert find_unit("mpa") is None, "mPa or MPa?"
    assert find_unit("KPA") == find_unit("kPa")


def test_gauge_pressure_needs_the_ambient_pressure() -> None:
    with pytest.raises(UnitError, match=r"'barg' is gauge pressure.*'kPa'.*offset"):
        conversion("barg", "kPa")


def test_unknown_unit_lists_near_ones() -> None:
    with pytest.raises(UnitError, match=r"'kpaa?x' is not known.*kPa"):
        conversion("kpax", "kPa")


def test_canonical_units_are_known() -> None:
    assert len(CANONICAL) == 21
    assert all(conversion(u, u) == (1.0, 0.0) for u in CANONICAL.values())


def test_units_that_only_pint_knows() -> None:
    pytest.importorskip("pint")
    assert conversion("slug/minute", "g/s")[0] == pytest.approx(14593.90294 / 60, rel=1e-6)
    assert conversion("ft*lbf", "Nm")[0] == pytest.approx(1.3558179483314)
    assert conversion("yard/minute", "m/s")[0] == pytest.approx(0.9144 / 60)


@pytest.mark.parametrize(
    ("word", "target"),
    [("U/fortnight", "rpm"), ("1/fortnight", "rpm"), ("turn/day", "rpm"), ("delta_degC", "K"),
     ("furlong", "kPa"), ("lambda", "m"), ("kPa abs rel", "kPa"), ("", "kPa"), ("1e999 m", "m"),
     ("__import__('os')", "m")],
)  # fmt: skip
def test_where_pint_would_guess_it_is_not_asked(word: str, target: str) -> None:
    with pytest.raises(UnitError):
        conversion(word, target)
