from __future__ import annotations

import tempfile
from pathlib import Path

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ingest import read_log
from ingest.blocks import join
from ingest.errors import LogError
from ingest.files import read_header
from ingest.log import Log
from ingest.maps import NameMap, TimeMap
from ingest.readers import csv


def read(folder: Path, content: str | bytes, names: NameMap | None = None) -> Log:
    path = folder / "x.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_log(path, names)


FINITE = st.floats(allow_nan=False, allow_infinity=False)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    rows=st.lists(st.tuples(FINITE, FINITE, st.none() | FINITE), min_size=1, max_size=6),
    separator=st.sampled_from([";", ",", "\t", "|"]),
    comma=st.booleans(),
    end=st.sampled_from(["\n", "\r\n"]),
    trailing=st.booleans(),
    quoted=st.booleans(),
    above=st.lists(st.sampled_from(["Bench 4; run 7", "", "Operator,Ä. Ö.", "Zeit: 12:03"]), max_size=3),
    units=st.sampled_from(["", "row", "brackets"]),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "latin-1", "utf-16"]),
    missing=st.sampled_from(["", "NaN", "---", "#N/A", " nan "]),
)
def test_every_dialect_gives_the_numbers_as_written(
    rows: list[tuple[float, float, float | None]],
    separator: str,
    comma: bool,
    end: str,
    trailing: bool,
    quoted: bool,
    above: list[str],
    units: str,
    encoding: str,
    missing: str,
) -> None:
    comma = comma and separator != ","

    def cell(value: float | None) -> str:
        return missing if value is None else repr(value).replace(".", "," if comma else ".")

    names = ["Zeit", "p_Bst", "Öltemp"]
    if units == "brackets":
        names = ["Zeit [s]", "p_Bst [hPa]", "Öltemp [°C]"]
    lines = [[f'"{n}"' if quoted else n for n in names]]
    lines += [["s", "hPa", "°C"]] if units == "row" else []
    lines += [[cell(v) for v in row] for row in rows]
    tail = separator if trailing else ""
    text = end.join([*above, *(separator.join(line) + tail for line in lines), ""])
    with tempfile.TemporaryDirectory() as folder:
        log = read(Path(folder), text.encode(encoding))
    frame = log.groups["data"].frame
    assert frame.columns == ["time", "p_Bst", "Öltemp"]
    assert frame["time"].to_list() == [r[0] for r in rows]
    scale = 0.1 if units else 1.0
    assert frame["p_Bst"].to_list() == [r[1] * scale for r in rows]
    assert frame["Öltemp"].to_list() == [r[2] for r in rows]
    assert log.signals["Öltemp"].unit == ("°C" if units else None)
    assert log.signals["p_Bst"].flags == (() if units else ("unit assumed",))
    assert "notes" not in log.facts
    assert [line for line in log.facts.get("head", []) if line] == [a for a in above if a]


@pytest.mark.parametrize(
    ("header", "cells", "expected"),
    [
        ("time,a", "0.25", 0.25),
        ("TIME [ms],a", "300", 0.3),
        ("t_ms,a", "300", 0.3),
        ("Time Stamp (us),a", "300000", 0.3),
        ("timestamp_ns,a", "300000000", 0.3),
        ("elapsed time [min],a", "2", 120.0),
        ("a [1],t", "300", 0.25),
    ],
)
def test_time_column_and_its_unit(tmp_path: Path, header: str, cells: str, expected: float) -> None:
    row = f"{cells},1" if not header.endswith(",t") else f"1,{expected}"
    assert read(tmp_path, f"{header}\n{row}\n").groups["data"].time.tolist() == [expected]


@pytest.mark.parametrize(
    ("cells", "start", "expected"),
    [
        (("2024-05-01T12:00:00.500Z", "2024-05-01T12:00:01.000Z"), "2024-05-01T12:00:00.5", [0.0, 0.5]),
        (("2024-05-01 23:59:59,75", "2024-05-02 00:00:00,00"), "2024-05-01T23:59:59.75", [0.0, 0.25]),
        (("01.05.2024 12:00:00", "01.05.2024 12:01:00"), "2024-05-01T12:00:00", [0.0, 60.0]),
        (("00:00:01.5", "00:01:00.0"), None, [1.5, 60.0]),
        (("12:00:00", "noon"), None, [43200.0]),
    ],
)
def test_dates_and_clock_times(
    tmp_path: Path, cells: tuple[str, str], start: str | None, expected: list[float]
) -> None:
    log = read(tmp_path, f"Zeit;a\n{cells[0]};1,5\n{cells[1]};2,5\n")
    assert log.groups["data"].time.tolist() == expected
    assert (start is None) == ("start_time" not in log.facts)
    assert log.facts.get("start_time", "").startswith(start or "")
    assert ("notes" in log.facts) == (len(expected) < 2)


def test_time_column_by_map(tmp_path: Path) -> None:
    names = NameMap(time=TimeMap(source=("zyklus",), unit="ms"))
    log = read(tmp_path, "zyklus,time\n500,1\n", names)
    assert log.groups["data"].frame.rows() == [(0.5, 1.0)]
    assert log.signals["time_2"].source_name == "time"


def test_states_missing_cells_and_unreadable_ones(tmp_path: Path) -> None:
    log = read(tmp_path, "time,gear,p,q\n0,D,1.5 ,\n1,N, 2,1\n2,---,ERR,#N/A\n3,D,ERR,NaN\n4,,5,1.#QNAN\n")
    frame = log.groups["data"].frame
    assert frame["gear"].to_list() == ["D", "N", None, "D", None]
    assert (log.signals["gear"].kind, log.signals["gear"].resample) == ("state", "hold")
    assert frame["p"].to_list() == [1.5, 2.0, None, None, 5.0]
    assert log.signals["p"].flags == ("cells are not numbers, such as 'ERR'",)
    assert log.facts["notes"] == ["p: 2 cells are not numbers, such as 'ERR'"]
    assert frame["q"].to_list() == [None, 1.0, None, None, None]
    assert log.signals["q"].flags == ()


def test_late_surprises_do_not_change_a_type(tmp_path: Path) -> None:
    rows = "".join(f"{i},{i}\n" for i in range(5000))
    frame = read(tmp_path, f"time,a\n{rows}5000,0.5\n5001,1e-3\n").groups["data"].frame
    assert frame["a"].to_list() == [*map(float, range(5000)), 0.5, 1e-3]


@pytest.mark.parametrize(
    ("tail", "fact", "words"),
    [("2,3", "notes", "may be cut in a number"), ("2", "salvaged", "1 of 2 fields")],
)
def test_last_line_without_end_is_dropped_and_told(tmp_path: Path, tail: str, fact: str, words: str) -> None:
    log = read(tmp_path, f"time,a\n0,1\n1,2\n{tail}")
    assert log.groups["data"].frame["a"].to_list() == [1.0, 2.0]
    assert words in log.facts[fact][0]


def test_any_cut_of_a_file_gives_a_part_of_its_rows(tmp_path: Path) -> None:
    text = "time;p_Bst\ns;kPa\n" + "".join(f"{i};{100 + i},25\n" for i in range(10))
    whole = read(tmp_path, text).groups["data"].frame
    for end in range(1, len(text)):
        try:
            part = read(tmp_path, text[:end]).groups["data"].frame
        except LogError:
            assert text[:end].count("\n") <= 2, "at least one whole row is read"
        else:
            assert part.equals(whole.head(part.height))
            assert part.height == text[:end].count("\n") - 2


def test_what_was_dropped_is_told(tmp_path: Path) -> None:
    log = read(tmp_path, b"time,a,b\n0,1,2\n,1,2\n\n1,2\n2,3,4\n\0\0\0")
    assert log.groups["data"].frame.rows() == [(0.0, 1.0, 2.0), (1.0, 2.0, None), (2.0, 3.0, 4.0)]
    notes = " ".join(log.facts["notes"])
    assert "zero bytes" in notes
    assert "1 rows without a time" in notes
    assert "1 rows have fewer fields than the 3 names" in notes


def test_names_that_are_not_unique_or_not_there(tmp_path: Path) -> None:
    log = read(tmp_path, "time,a,a,,b,\n0,1,2,3,4,\n")
    assert list(log.signals) == ["a", "a_2", "column_4", "b"]
    assert log.signals["a_2"].source_name == "a"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", r"x\.csv: the file is empty"),
        ("time,a\n", r"no samples: below the names 'time,a'"),
        ("time,a\ns,kPa\n", "no samples"),
        ("time,a\n0,1", "no complete row|no samples"),
        ("hello\nworld\n", "not a table"),
        ("tiem,a\n0,1\n", r"no time column.*did you mean tiem"),
        ("time [kPa],a\n0,1\n", r"time column 'time \[kPa\]'.*absolute pressure"),
        ("time,a\n0,1\n1,2,3\n2,3,4\n", r"row 2 of the data has 3 fields, but there are 2 names"),
        ("# dynoscope {broken\ntime,a\n0,1\n", "first line.*damaged"),
        ('# dynoscope {"version": 99}\ntime,a\n0,1\n', "newer dynoscope"),
    ],
)
def test_clear_words_for_what_is_no_log(tmp_path: Path, content: str, words: str) -> None:
    with pytest.raises(LogError, match=words):
        read(tmp_path, content)


def test_header_without_rows(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text("time;p_Bst\ns;bar\n" + "0;1\n" * 100_000)
    log = read_header(path)
    assert log.groups["data"].frame.schema == {"time": pl.Float64, "p_Bst": pl.Float64}
    assert log.signals["p_Bst"].source_unit == "bar"
    assert log.groups["data"].frame.is_empty()


def test_numbers_without_names(tmp_path: Path) -> None:
    text = "1.5,2\n3,4\n"
    log = read(tmp_path, text)
    assert log.groups["data"].frame.rows() == [(0.0, 1.5, 2.0), (1.0, 3.0, 4.0)]
    assert log.signals["c01"].flags == ("no name in the file",)
    assert "names no channels" in log.facts["notes"][0]
    assert "rows are counted as 1 s each" in log.facts["notes"][1]
    timed = read(tmp_path, text, NameMap(time=TimeMap(rate=10.0)))
    assert timed.groups["data"].time.tolist() == [0.0, 0.1]
    assert len(timed.facts["notes"]) == 1
    chosen = read(tmp_path, text, NameMap(time=TimeMap(source=("c01",), unit="ms")))
    assert chosen.groups["data"].frame.rows() == [(0.0015, 2.0), (0.003, 4.0)]
    named = read(tmp_path, "a,b\nV,A\n1,2\n", NameMap(time=TimeMap(rate=4.0)))
    assert (list(named.signals), named.signals["b"].unit) == (["a", "b"], "A")


@pytest.mark.parametrize(
    ("rows", "start", "expected"),
    [
        (("01.05.2024;23:59:59,5", "02.05.2024;00:00:00,5"), "2024-05-01T23:59:59.5", [0.0, 1.0]),
        (("5/1/2024;11:59:59 PM", "5/2/2024;12:00:01 AM"), "2024-05-01T23:59:59", [0.0, 2.0]),
        (("13/5/2024;10:00", "13/5/2024;10:01"), "2024-05-13T10:00:00", [0.0, 60.0]),
    ],
)
def test_date_and_time_in_two_columns(
    tmp_path: Path, rows: tuple[str, str], start: str, expected: list[float]
) -> None:
    log = read(tmp_path, f"Datum;Zeit;a\n{rows[0]};1,5\n{rows[1]};2,5\n")
    assert log.groups["data"].frame.to_dict(as_series=False) == {"time": expected, "a": [1.5, 2.5]}
    assert log.facts["start_time"] == start


@pytest.mark.parametrize(
    ("separator", "cells", "expected"),
    [
        (";", ("1.234,5", "1.234", "7"), [1234.5, 1234.0, 7.0]),
        (";", ("1 234,5", "12'345", "-7 000"), [1234.5, 12345.0, -7000.0]),
        (",", ('"1,234.5"', '"1,234"', "7"), [1234.5, 1234.0, 7.0]),
        (",", ('"1,234,567"', "2", "7"), [1234567.0, 2.0, 7.0]),
        (",", ('"1,234"', "2", "7"), [None, 2.0, 7.0]),
        (";", ("1.234", "2,5", "7"), [None, 2.5, 7.0]),
        (";", ("1.234", "2.5", "0,5"), [1.234, 2.5, 0.5]),
    ],
)
def test_thousands(tmp_path: Path, separator: str, cells: tuple[str, ...], expected: list[float]) -> None:
    comma = "," if separator == ";" else "."
    rows = "".join(f"{i}{comma}5{separator}{cell}\n" for i, cell in enumerate(cells))
    log = read(tmp_path, f"time{separator}a\n{rows}")
    assert log.groups["data"].frame["a"].to_list() == expected
    assert bool(log.signals["a"].flags) == (None in expected), "what could be two numbers is none, and told"


def test_columns_by_spaces(tmp_path: Path) -> None:
    log = read(tmp_path, "Bench 4\n  time   p_Bst\n    s     kPa\n  0.0   100.0 \n  0.5    99.25\n")
    assert log.groups["data"].frame.rows() == [(0.0, 100.0), (0.5, 99.25)]
    assert log.signals["p_Bst"].unit == "kPa"


def test_several_rasters_with_empty_cells_are_taken_apart(tmp_path: Path) -> None:
    rows = [f"{i / 100},{i},{i if i % 10 == 0 else ''},{-i if i % 10 == 0 else ''}" for i in range(200)]
    log = read(tmp_path, "time,fast,slow,slow2\n" + "\n".join(rows) + "\n")
    assert {k: (list(g.signals), g.frame.height) for k, g in log.groups.items()} == {
        "data": (["fast"], 200),
        "data_2": (["slow", "slow2"], 20),
    }
    assert log.groups["data_2"].frame["slow"].to_list() == [float(i) for i in range(0, 200, 10)]
    assert log.groups["data_2"].rate_hz == pytest.approx(10.0)


def test_a_row_with_too_many_fields_is_dropped_and_told(tmp_path: Path) -> None:
    text = "time,a\n" + "".join(f"{i},{i}\n" for i in range(300)).replace("\n150,", "\n150,9,9,9,")
    log = read(tmp_path, text)
    assert log.values("a").tolist() == [float(i) for i in range(300) if i != 150]
    assert (
        "1 rows have too many fields and were dropped: row 151 of the data has 5" in log.facts["salvaged"][0]
    )


BLOCKED = "Zeit;p;word\nms;bar;\n" + "".join(
    f"{i * 10},5;{'ERR' if i == 77 else f'{i},25'};{'on' if i % 3 else 'off'}\n" for i in range(120)
)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
@pytest.mark.parametrize("tail", ["", "1210,5;1", "\0\0\0"])
@pytest.mark.parametrize("size", [40, 333, None])
def test_parts_make_the_whole(tmp_path: Path, encoding: str, tail: str, size: int | None) -> None:
    path = tmp_path / "x.csv"
    path.write_bytes((f"Prüfstand\n{BLOCKED}{tail}").encode(encoding))
    parts = [p.log for p in csv.blocks(path, NameMap(), size)]
    whole = join(parts)
    assert len(parts) > 2 or size is None
    assert whole.groups["data"].frame["time"].to_list() == pytest.approx(
        [0.01 * i + 5e-4 for i in range(120)]
    )
    assert whole.groups["data"].frame["p"].to_list() == [i + 0.25 if i != 77 else None for i in range(120)]
    assert whole.groups["data"].frame["word"].to_list() == ["on" if i % 3 else "off" for i in range(120)]
    assert whole.signals["p"].flags == ("cells are not numbers, such as 'ERR'",)
    assert ("salvaged" in whole.facts) == tail.startswith("1")
    assert len(whole.facts["notes"]) == 1 + tail.startswith("\0")
    assert read_log(path).groups["data"].frame.equals(whole.groups["data"].frame)
