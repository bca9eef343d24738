from __future__ import annotations

from pathlib import Path

import polars as pl
import pytest

from ingest.errors import LogError, MapError, UnitError
from ingest.log import Group, Log, Signal
from ingest.mapping import apply_map
from ingest.maps import NameMap, SignalMap, TimeMap, load_map


def log_of(units: dict[str, str | None], dtype: type[pl.DataType] = pl.Float64) -> Log:
    frame = pl.DataFrame({"time": [0.0, 1.0]} | {n: pl.Series([1, 2]).cast(dtype) for n in units})
    return Log("x", {"g": Group("g", frame, {n: Signal(name=n, unit=u) for n, u in units.items()})})


def one(target: str, source: str, **more: object) -> NameMap:
    return NameMap(signals={target: SignalMap(source=(source,), **more)})  # type: ignore[arg-type]


def test_canonical_signals_need_no_map() -> None:
    log = apply_map(log_of({"p_Bst": "bar", "n_Eng": "U/min", "T_Int": "°C", "foo": "Pa"}), NameMap())
    assert log.values("p_Bst").tolist() == [100.0, 200.0]
    assert log.values("T_Int").tolist() == [274.15, 275.15]
    assert log.values("foo").tolist() == [1.0, 2.0]
    assert [s.unit for s in log.signals.values()] == ["kPa", "rpm", "K", "Pa"]
    told = log.signals["p_Bst"]
    assert (told.source_name, told.source_unit, told.scale, told.offset) == ("p_Bst", "bar", 100.0, 0.0)


def test_without_any_unit_the_canonical_one_is_assumed_and_flagged() -> None:
    log = apply_map(log_of({"p_Bst": None, "foo": None, "bar": "wombat"}), NameMap())
    assert (log.signals["p_Bst"].unit, log.signals["p_Bst"].flags) == ("kPa", ("unit assumed",))
    assert (log.signals["foo"].unit, log.signals["foo"].flags) == (None, ())
    assert (log.signals["bar"].unit, log.signals["bar"].flags) == ("wombat", ("unit unknown",))


def test_map_renames_scales_and_converts() -> None:
    names = NameMap(
        signals={
            "p_Bst": SignalMap(source=("nope", "pic*"), unit="Pa"),
            "m_Fuel": SignalMap(source=("fuel",), unit="mg/stroke", scale=1e6, kind="state", resample="hold"),
            "p_Amb": SignalMap(source=("amb",), unit="bar", offset=1.0),
            "soot": SignalMap(source=("fsn",)),
        },
        vehicle="bench 4",
    )
    log = apply_map(log_of({"pic_1": "kPa", "fuel": "kg/s", "amb": None, "fsn": "FSN", "other": "V"}), names)
    assert list(log.signals) == ["p_Bst", "m_Fuel", "p_Amb", "soot", "other"]
    assert log.values("p_Bst").tolist() == [0.001, 0.002], "the map's unit goes before the file's"
    assert log.values("m_Fuel").tolist() == [1e6, 2e6]
    assert log.values("p_Amb").tolist() == [200.0, 300.0], "offset is in the map's unit"
    assert log.signals["p_Bst"].source_name == "pic_1"
    assert (log.signals["m_Fuel"].kind, log.signals["m_Fuel"].resample) == ("state", "hold")
    assert log.facts["vehicle"] == "bench 4"


@pytest.mark.parametrize(
    "names",
    [
        NameMap(),
        one("p_Bst", "p_Bst", unit="Pa"),
        one("p_Bst", "p_Bst", scale=2.0),
        one("p_Bst", "p_*", unit="bar", scale=3.0, offset=1.0),
        one("T_Int", "t", unit="°C"),
    ],
)
@pytest.mark.parametrize("unit", [None, "bar", "kPa"])
def test_applying_twice_changes_nothing(names: NameMap, unit: str | None) -> None:
    once = apply_map(log_of({"p_Bst": unit, "t": None}), names)
    assert apply_map(once, names).equals(once)


def test_float32_stays_and_integers_become_double() -> None:
    names = one("p_Bst", "a", unit="bar")
    assert apply_map(log_of({"a": None}, pl.Float32), names).groups["g"].frame.schema["p_Bst"] == pl.Float32
    assert apply_map(log_of({"a": None}, pl.Int16), names).groups["g"].frame.schema["p_Bst"] == pl.Float64
    untouched = one("p_Bst", "a", unit="kPa")
    assert apply_map(log_of({"a": None}, pl.Int16), untouched).groups["g"].frame.schema["p_Bst"] == pl.Int16


def test_missing_source_is_told() -> None:
    log = apply_map(log_of({"pressure_ic": "Pa"}), one("p_Bst", "pressure_cc"))
    assert log.facts["notes"][0].startswith(
        "map: no channel pressure_cc for p_Bst; did you mean pressure_ic?"
    )


@pytest.mark.parametrize(
    ("units", "names", "error", "words"),
    [
        ({"p_Bst": "K"}, NameMap(), UnitError, r"'p_Bst'.*'K' is temperature.*absolute pressure"),
        ({"a": "furlong"}, one("p_Bst", "a"), UnitError, r"channel 'a' \(signal p_Bst\).*'furlong'"),
        ({"a1": None, "a2": None}, one("p_Bst", "a?"), LogError, r"fits 2 channels \['a1', 'a2'\]"),
        ({"a": None, "p_Bst": None}, one("p_Bst", "a"), LogError, r"p_Bst would be there twice, from 'a'"),
    ],
)
def test_mistakes_name_channel_and_unit(
    units: dict[str, str | None], names: NameMap, error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        apply_map(log_of(units), names)


def test_two_signals_from_one_channel_and_text_are_refused() -> None:
    both = NameMap(signals={"p_Bst": SignalMap(source=("a",)), "p_Int": SignalMap(source=("a",))})
    with pytest.raises(LogError, match="already the source of p_Bst"):
        apply_map(log_of({"a": None}), both)
    with pytest.raises(LogError, match="holds text"):
        apply_map(log_of({"p_Bst": "bar"}, pl.String), NameMap())


def test_swapped_names() -> None:
    swap = NameMap(signals={"p_Bst": SignalMap(source=("p_Int",)), "p_Int": SignalMap(source=("p_Bst",))})
    log = apply_map(log_of({"p_Bst": "kPa", "p_Int": "bar"}), swap)
    assert log.values("p_Bst").tolist() == [100.0, 200.0]
    assert log.values("p_Int").tolist() == [1.0, 2.0]


def test_load_map(tmp_path: Path) -> None:
    path = tmp_path / "m.toml"
    path.write_text(
        'vehicle = "v"\n[time]\nsource = ["Zeit", "t"]\nunit = "ms"\n'
        '[signals.p_Bst]\nsource = "pic"\nunit = "Pa"\nscale = 2\nkind = "state"\n'
    )
    assert load_map(path) == NameMap(
        signals={"p_Bst": SignalMap(source=("pic",), unit="Pa", scale=2.0, kind="state")},
        time=TimeMap(source=("Zeit", "t"), unit="ms"),
        vehicle="v",
        origin=str(path),
    )


def test_all_mistakes_of_a_map_at_once(tmp_path: Path) -> None:
    path = tmp_path / "m.toml"
    path.write_text(
        'vehicel = "v"\nvehicle = 3\n[time]\nunit = "kPa"\n'
        '[signals.p_Bst]\nsorce = "a"\nunit = "K"\n[signals.p_int]\nsource = "b"\n'
        '[signals.x]\nsource = []\nscale = 0\noffset = inf\nkind = "stat"\nresample = true\n'
        "[signals]\ny = 3\n"
    )
    with pytest.raises(MapError) as caught:
        load_map(path)
    for words in (
        "no setting 'vehicel'; did you mean vehicle?",
        "vehicle is 3; expected text",
        "[time]: unit 'kPa' is absolute pressure, but 's' is time",
        "no setting 'sorce'; did you mean source",
        "[signals.p_Bst]: unit 'K' is temperature",
        "[signals.p_Bst] source is None",
        "[signals.p_int]: did you mean p_Int?",
        "[signals.x] source is []",
        "[signals.x] scale is 0",
        "[signals.x] offset is inf",
        "kind is 'stat'; did you mean state?",
        "resample is True",
        "[signals.y] is 3; expected a table",
    ):
        assert words in str(caught.value)


@pytest.mark.parametrize("content", [b"[signals", b"\xff\xfe\x00", None])
def test_unreadable_map(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "m.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(MapError, match=r"m\.toml cannot be read"):
        load_map(path)


@pytest.mark.parametrize(
    "path", sorted((Path(__file__).parents[2] / "data" / "maps").glob("*.toml")), ids=lambda p: p.stem
)
def test_maps_that_come_along(path: Path) -> None:
    names = load_map(path)
    assert {"p_Bst", "p_Int", "W_HFM", "n_Eng"} <= set(names.signals)


def test_sign_and_valid_range(tmp_path: Path) -> None:
    path = tmp_path / "m.toml"
    path.write_text(
        '[signals.p_Bst]\nsource = "a"\nunit = "bar"\nsign = -1\nscale = 2\nvalid = [-300, 150]\n'
        '[signals.p_Int]\nsource = ["nope", "b"]\nvalid = [0, 10]\n'
    )
    log = apply_map(log_of({"a": None, "b": "kPa"}), load_map(path))
    assert log.groups["g"].frame["p_Bst"].to_list() == [-200.0, None]
    assert "values outside the map's valid range are missing" in log.signals["p_Bst"].flags
    assert log.signals["p_Int"].flags == ()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("sign = 2", "sign is 2; expected 1 or -1"),
        ("valid = [3, 1]", r"valid is \[3, 1\]"),
        ("valid = 3", "valid is 3"),
    ],
)
def test_wrong_sign_or_range(tmp_path: Path, line: str, words: str) -> None:
    path = tmp_path / "m.toml"
    path.write_text(f'[signals.p_Bst]\nsource = "a"\n{line}\n')
    with pytest.raises(MapError, match=words):
        load_map(path)


@pytest.mark.parametrize(
    ("name", "unit", "dtype", "kind"),
    [
        ("p", None, pl.Float64, "continuous"),
        ("ActGear", None, pl.Float64, "state"),
        ("gear_ratio", "1/min", pl.Float64, "continuous"),
        ("msg_counter", None, pl.Float64, "counter"),
        ("anything", None, pl.UInt8, "state"),
        ("anything", "km/h", pl.UInt8, "continuous"),
        ("n_Eng", None, pl.Int16, "continuous"),
        ("x", None, pl.Boolean, "state"),
    ],
)
def test_states_and_counters_are_not_to_be_interpolated(
    name: str, unit: str | None, dtype: type[pl.DataType], kind: str
) -> None:
    signal = apply_map(log_of({name: unit}, dtype), NameMap()).signals[name]
    assert (signal.kind, signal.resample) == (kind, "linear" if kind == "continuous" else "hold")
