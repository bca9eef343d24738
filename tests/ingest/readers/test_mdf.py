from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ingest import mdf_samples, read_log, write_log
from ingest.blocks import join
from ingest.errors import LogError
from ingest.files import read_blocks, read_header
from ingest.log import Event, Group, Log, Signal
from ingest.maps import NameMap, SignalMap
from ingest.mdf_header import plain_recording
from ingest.readers import mdf

asammdf = pytest.importorskip("asammdf")
REAL = Path(__file__).parents[3].parent / "shared" / "data" / "mdf4"
RNG = np.random.default_rng(0)
TIME = np.arange(3000) * 0.01
VALUES = RNG.normal(100, 5, 3000).astype(np.float32)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two rasters, invalid samples, text by conversion, a name in both groups."""
    path = tmp_path_factory.mktemp("mdf") / "x.mf4"
    table = {f"val_{i}": i for i in range(2)} | {f"text_{i}": w for i, w in enumerate(("off", "on"))}
    with asammdf.MDF(version="4.10") as file:
        bad = np.zeros(3000, bool)
        bad[5:8] = True
        fast = [
            asammdf.Signal(VALUES, TIME, name="p_Bst", unit="bar", comment="boost"),
            asammdf.Signal(
                np.arange(3000, dtype=np.int16), TIME, name="n", unit="U/min", invalidation_bits=bad
            ),
            asammdf.Signal(np.arange(3000) % 2, TIME, name="switch", conversion=table),
            asammdf.Signal(np.ones((3000, 3), np.uint8), TIME, name="array"),
        ]
        file.append(fast, acq_name="ecu", comment="")
        slow = [asammdf.Signal(np.arange(300, dtype=">f8"), TIME[::10] + 0.003, name="n", unit="-")]
        file.append(slow, acq_name="bench", comment="")
        file.save(path, overwrite=True, compression=2)
    return path


def test_groups_units_and_invalid_samples(path: Path) -> None:
    log = read_log(path)
    ecu, bench = log.groups["ecu"].frame, log.groups["bench"].frame
    assert ecu.columns == ["time", "p_Bst", "ecu.n", "switch"], "a name in two groups gets its group's"
    np.testing.assert_array_equal(ecu["time"], TIME)
    np.testing.assert_array_equal(ecu["p_Bst"].to_numpy(), VALUES * np.float32(100.0))
    assert (log.signals["p_Bst"].source_unit, log.signals["p_Bst"].description) == ("bar", "boost")
    assert ecu["ecu.n"].to_list() == [None if i in (5, 6, 7) else i for i in range(3000)]
    assert ecu["switch"].to_list() == ["on" if i % 2 else "off" for i in range(3000)]
    assert (log.signals["switch"].kind, log.signals["switch"].resample) == ("state", "hold")
    np.testing.assert_array_equal(bench["bench.n"], np.arange(300.0))
    assert log.signals["bench.n"].source_name == "n"
    assert "'array' was skipped" in log.facts["notes"][0]
    names = NameMap(signals={"n_Eng": SignalMap(source=("ecu.n",))})
    assert read_log(path, names).groups["ecu"].frame["n_Eng"][100] == 100.0


def test_header_and_parts(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = read_log(path)
    head = read_header(path)
    assert head.signals == whole.signals
    assert head.facts["rows"] == {"ecu": 3000, "bench": 300}
    parts = [p.log for p in mdf.blocks(path, NameMap(), 7000)]
    assert len(parts) > 3
    joined = join(parts)
    assert all(joined.groups[k].frame.height == g.frame.height for k, g in whole.groups.items())
    assert joined.groups["ecu"].frame.drop("p_Bst").equals(whole.groups["ecu"].frame.drop("p_Bst"))
    assert join(read_blocks(path)).equals(whole)


def test_a_huge_block_is_read_in_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As of writers that make one block of everything: no part needs all of it."""
    path = tmp_path / "x.mf4"
    with asammdf.MDF(version="4.10") as file:
        signals = [asammdf.Signal(VALUES + i, TIME, name=f"s{i}", unit="V") for i in range(3)]
        file.append(signals, acq_name="ecu", comment="")
        file.save(path, overwrite=True, compression=0)
    whole = read_log(path)
    monkeypatch.setattr(mdf_samples, "_PIECE", 1000)
    with path.open("rb") as stream, asammdf.MDF(stream) as file:
        group = file.groups[0]
        (block,) = group.data_blocks
        record = group.channel_group.samples_byte_nr
        mdf_samples.cut_blocks(group)
        sizes = [b.original_size for b in group.data_blocks]
        ends = [b.address + b.original_size for b in group.data_blocks]
        assert [b.address for b in group.data_blocks] == [block.address, *ends[:-1]]
        assert (sum(sizes), ends[-1]) == (3000 * record, block.address + block.original_size)
        assert max(sizes) <= 1000
        assert all(n % record == 0 for n in sizes)
    parts = [p.log for p in mdf.blocks(path, NameMap(), 7000)]
    assert len(parts) > 5
    assert join(parts).groups["ecu"].frame.equals(whole.groups["ecu"].frame)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All plain types, with and without a linear conversion, and texts."""
    path = tmp_path_factory.mktemp("mdf") / "plain.mf4"
    signals, words = [], {"val_0": 0, "text_0": b"off", "default": b"?"}
    for kind in ("u1", "u2", "u4", "u8", "i1", "i2", "i4", "i8", "f2", "f4", "f8", ">i4", ">f8"):
        values = np.arange(5).astype(kind)
        for a, b in ((2.0, 1.0), (1.0, 0.0)):
            conversion = {"a": a, "b": b}
            signals += [asammdf.Signal(values, TIME[:5], name=f"{kind}_{a}", unit="V", conversion=conversion)]
        signals += [asammdf.Signal(values, TIME[:5], name=kind, unit="°C", comment=f"<CNcomment>{kind}")]
    signals += [asammdf.Signal(np.arange(5, dtype="u1"), TIME[:5], name="switch", conversion=words)]
    signals += [
        asammdf.Signal(np.array([b"a", b"bb", b"", b"c", b"d"]), TIME[:5], name="s", encoding="utf-8")
    ]
    with asammdf.MDF(version="4.10") as file:
        file.append(signals, acq_name="ecu", comment="a comment")
        file.append([asammdf.Signal(VALUES, TIME, name="u1", unit="V")], comment="bench\nx")
        file.save(path, overwrite=True, compression=0)
    return path


def test_a_plain_header_is_that_of_asammdf(
    plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [plain, *sorted(REAL.glob("*.mf4"))]
    for compression in (0, 2):
        with asammdf.MDF(plain) as file:
            files.append(Path(file.save(tmp_path / f"{compression}.mf4", compression=compression)))
    log = read_log(plain)
    files.append(write_log(replace(log, facts={"seed": 1}), tmp_path / "ours.mf4"))
    light = {f: plain_recording(f) for f in files}
    assert all(light[f] is not None for f in files if f.parent != REAL)
    monkeypatch.setattr(mdf, "plain_recording", lambda path: None)
    for file, found in light.items():
        if found is not None:
            other = mdf.header(file, NameMap())
            assert found.log.equals(other.log), file
            assert (found.log.facts, found.ours) == (other.log.facts, other.ours), file


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_header_is_left_to_asammdf(data: st.DataObject, plain: Path, tmp_path: Path) -> None:
    content = bytearray(plain.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    bad = tmp_path / "bad.mf4"
    bad.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    with suppress(LogError):  # it declares more than this machine can hold
        plain_recording(bad)


def test_version_3(tmp_path: Path) -> None:
    with asammdf.MDF(version="3.30") as file:
        file.append([asammdf.Signal(VALUES, TIME, name="T_Int", unit="°C")])
        file.save(tmp_path / "x.mdf", overwrite=True)
    log = read_log(tmp_path / "x.mdf")
    np.testing.assert_allclose(log.values("T_Int"), VALUES.astype(float) + 273.15, rtol=1e-6)


def test_ours_comes_back(tmp_path: Path) -> None:
    frame = pl.DataFrame(
        {
            "time": [0.0, 1.0, 2.0],
            "p_Bst": [1.0, None, 3.0],
            "word": ["x", None, "yyü"],
            "i": pl.Series([1, None, 3], dtype=pl.Int16),
        }
    )
    signals = {"p_Bst": Signal(name="p_Bst", unit="kPa", flags=("unit assumed",))}
    events = (Event(t_start=1.0, kind="maf_gain", source="truth", magnitude=0.05, unit="1"),)
    log = Log("drive", {"a/b": Group("a/b", frame, signals)}, events, {"seed": 1})
    assert read_log(write_log(log, tmp_path / "x.mf4")).equals(log)
    with asammdf.MDF(tmp_path / "x.mf4") as file:  # and to others it is plain MDF
        assert file.get("p_Bst").unit == "kPa"
        assert file.get("i").samples.tolist() == [1, 3], "the invalid one is left out"


def test_a_cut_or_broken_file_is_told(path: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    good, bad = path.read_bytes(), tmp_path / "bad.mf4"
    whole = read_log(path)
    told = 0
    for content in (
        *(good[: len(good) * part // 20] for part in range(1, 20)),
        good[:-300],
        *(good[:at] + bytes([good[at] ^ 0xFF] * 8) + good[at + 8 :] for at in range(100, 3000, 97)),
    ):
        bad.write_bytes(content)
        try:
            log = read_log(bad)
        except LogError as error:
            assert "bad.mf4" in str(error)  # noqa: PT017 - whether it is raised depends on the damage
            told += 1
            continue
        assert all(
            g.frame.height <= whole.groups[k].frame.height for k, g in log.groups.items() if k in whole.groups
        )
        told += "salvaged" in log.facts
    assert told >= 20
    assert "Exception ignored" not in capfd.readouterr().err


def test_what_is_no_measurement(tmp_path: Path) -> None:
    path = tmp_path / "x.mf4"
    path.write_bytes(b"MDF     4.10    " + bytes(200))
    with pytest.raises(LogError, match=r"x\.mf4: damaged MDF file"):
        read_log(path)
    with asammdf.MDF(version="4.10") as file:
        file.save(tmp_path / "empty.mf4", overwrite=True)
    with pytest.raises(LogError, match=r"empty\.mf4: no group has a time channel"):
        read_log(tmp_path / "empty.mf4")


@pytest.mark.skipif(not REAL.is_dir(), reason="the MDF files of other projects are not at hand")
@pytest.mark.parametrize("name", ["ASAP2_Demo_V171", "test_batch", "test_batch_cut_0", "test_metadata"])
def test_real_files_value_by_value(name: str) -> None:
    log = read_log(REAL / f"{name}.mf4")
    by_source: dict[str, Any] = {s.source_name or n: log.group_of(n).frame[n] for n, s in log.signals.items()}
    seen = 0
    with asammdf.MDF(REAL / f"{name}.mf4") as file:
        for index, group in enumerate(file.groups):
            for number, channel in enumerate(group.channels):
                if number == file.masters_db.get(index):
                    continue
                theirs = file.get(group=index, index=number)
                ours = by_source[channel.name]
                if theirs.samples.dtype.kind == "S":
                    words = [w.decode().rstrip("\0") or None for w in theirs.samples]
                    assert ours.to_list() == words
                else:
                    np.testing.assert_array_equal(ours.to_numpy(), theirs.samples)
                np.testing.assert_array_equal(log.group_of(ours.name).time, theirs.timestamps)
                seen += 1
    assert seen == len(log.signals)
