from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ingest import read_log
from ingest.can_signals import decode
from ingest.errors import LogError
from ingest.files import read_header
from ingest.maps import NameMap, load_map

can = pytest.importorskip("can")
cantools = pytest.importorskip("cantools")
DBC = """VERSION ""
BU_: ECU
BO_ 291 Engine: 8 ECU
 SG_ n_Eng : 0|16@1+ (0.25,0) [0|16383] "rpm" ECU
 SG_ T_Int : 23|12@0- (0.1,-40) [-244|164] "degC" ECU
 SG_ gear : 40|3@1+ (1,0) [0|7] "" ECU
BO_ 2566844926 Mux: 8 ECU
 SG_ page M : 0|8@1+ (1,0) [0|255] "" ECU
 SG_ a m0 : 8|32@1- (1,0) [0|0] "V" ECU
 SG_ b m1 : 8|16@0+ (0.5,1) [0|0] "A" ECU
VAL_ 291 gear 0 "N" 1 "first" ;
SIG_VALTYPE_ 2566844926 a : 1;
"""


@pytest.fixture(scope="module")
def database() -> object:
    return cantools.database.load_string(DBC, "dbc")


@pytest.fixture
def names(tmp_path: Path) -> NameMap:
    (tmp_path / "ecu.dbc").write_text(DBC)
    (tmp_path / "map.toml").write_text('dbc = ["ecu.dbc"]\n')
    return load_map(tmp_path / "map.toml")


def write(path: Path, database: object, frames: int = 300) -> list[dict[str, float]]:
    rng = np.random.default_rng(0)
    rows = []
    with (can.BLFWriter if path.suffix == ".blf" else can.ASCWriter)(path) as writer:
        for i in range(frames):
            row = {
                "n_Eng": float(rng.integers(0, 65536)) * 0.25,
                "T_Int": round(float(rng.integers(-2048, 2048)) * 0.1 - 40, 1),
                "gear": i % 8,
            }
            rows.append(row)
            data = database.encode_message(291, row, strict=False)  # type: ignore[attr-defined]
            stamp = 1.7e9 + i * 0.01 if path.suffix == ".blf" else i * 0.01
            writer.on_message_received(can.Message(stamp, 291, False, data=data, channel=0))
            mux = {"page": 0, "a": float(np.float32(i / 7))} if i % 2 else {"page": 1, "b": i * 0.5 + 1}
            data = database.encode_message(2566844926 & 0x1FFFFFFF, mux, strict=False)  # type: ignore[attr-defined]
            writer.on_message_received(
                can.Message(stamp, 2566844926 & 0x1FFFFFFF, True, data=data, channel=0)
            )
        writer.on_message_received(can.Message(stamp, 0x7FF, False, data=b"\1\2", channel=0))
    return rows


@pytest.mark.parametrize("suffix", [".blf", ".asc"])
def test_values_are_those_of_the_library(
    tmp_path: Path, database: object, names: NameMap, suffix: str
) -> None:
    path = tmp_path / f"x{suffix}"
    rows = write(path, database)
    log = read_log(path, names)
    assert set(log.groups) == {"Engine", "Mux", "7FF"}
    np.testing.assert_allclose(log.values("n_Eng"), [r["n_Eng"] for r in rows], rtol=1e-12)
    np.testing.assert_allclose(log.values("T_Int"), [r["T_Int"] + 273.15 for r in rows], rtol=1e-9)
    assert log.values("gear").tolist() == [r["gear"] for r in rows]
    assert (log.signals["gear"].kind, log.signals["gear"].description) == ("state", "0: N; 1: first")
    a, b = (log.groups["Mux"].frame[n].to_list() for n in "ab")
    assert a == [float(np.float32(i / 7)) if i % 2 else None for i in range(300)]
    assert b == [None if i % 2 else i * 0.5 + 1 for i in range(300)]
    np.testing.assert_allclose(log.groups["Engine"].time, np.arange(300) * 0.01, atol=1e-5)
    assert "1 frames of 1 identifiers are in no DBC: 7FF (1)" in log.facts["notes"][0]
    assert ("start_time" in log.facts) == (suffix == ".blf")
    assert read_header(path, names).facts["rows"] == {"Engine": 300, "Mux": 300, "7FF": 1}


def test_without_a_dbc_bytes_are_shown(tmp_path: Path, database: object) -> None:
    write(tmp_path / "x.blf", database, 3)
    log = read_log(tmp_path / "x.blf")
    assert log.values("7FF.byte1").tolist() == [2.0]
    assert log.signals["123.byte0"].flags == ("bytes as sent: no DBC describes this message",)
    assert "--dbc" in log.facts["notes"][0]


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    start=st.integers(0, 63),
    length=st.integers(1, 64),
    order=st.sampled_from([0, 1]),
    signed=st.booleans(),
    data=st.lists(st.binary(min_size=8, max_size=8), min_size=1, max_size=3),
)
def test_bits_as_the_library_takes_them(
    start: int, length: int, order: int, signed: bool, data: list[bytes]
) -> None:
    sign = "-" if signed else "+"
    text = f'VERSION ""\nBU_: E\nBO_ 1 M: 8 E\n SG_ s : {start}|{length}@{order}{sign} (1,0) [0|0] "" E\n'
    try:
        message = cantools.database.load_string(text, "dbc").messages[0]
    except cantools.database.Error:
        return  # does not fit into the frame
    matrix = np.frombuffer(b"".join(data), np.uint8).reshape(-1, 8)
    ours = decode(message, matrix, np.full(len(data), 8))["s"].to_list()
    assert ours == [message.decode(d)["s"] for d in data]


def test_short_frames_have_no_value(database: object) -> None:
    message = database.get_message_by_name("Engine")  # type: ignore[attr-defined]
    data = np.zeros((2, 8), np.uint8)
    found = decode(message, data, np.array([8, 2]))
    assert (found["n_Eng"].to_list(), found["gear"].to_list()) == ([0.0, 0.0], [0, None])


@pytest.mark.parametrize("suffix", [".blf", ".asc"])
def test_a_cut_is_told(tmp_path: Path, database: object, names: NameMap, suffix: str) -> None:
    path = tmp_path / f"x{suffix}"
    rows = write(path, database)
    good = path.read_bytes()
    for part in (0.3, 0.6, 0.97):
        path.write_bytes(good[: int(len(good) * part)])
        try:
            log = read_log(path, names)
        except LogError as error:
            assert path.name in str(error)  # noqa: PT017 - whether it is raised depends on the cut
            continue
        assert "salvaged" in log.facts
        got = log.values("n_Eng")
        assert len(got) < 300 or part > 0.9
        np.testing.assert_allclose(got[:-1], [r["n_Eng"] for r in rows][: len(got) - 1])


def test_damaged_trace_or_dbc(tmp_path: Path, database: object) -> None:
    path = tmp_path / "x.blf"
    path.write_bytes(b"LOGG" + bytes(10))
    with pytest.raises(LogError, match=r"x\.blf: damaged CAN trace"):
        read_log(path)
    write(path, database, 2)
    (tmp_path / "bad.dbc").write_text("this is no DBC")
    with pytest.raises(LogError, match=r"bad\.dbc is not a DBC"):
        read_log(path, NameMap(dbc=(tmp_path / "bad.dbc",)))
    with pytest.raises(LogError, match=r"none\.dbc cannot be read"):
        read_log(path, NameMap(dbc=(tmp_path / "none.dbc",)))
