from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from ingest import read_log
from ingest.errors import LogError
from ingest.files import read_header
from ingest.log import Log

h5py = pytest.importorskip("h5py")
TIME = np.arange(200) * 0.1
VALUES = np.random.default_rng(0).normal(size=200)


def check(log: Log) -> None:
    np.testing.assert_array_equal(log.values("p_Bst"), VALUES)
    np.testing.assert_array_equal(log.group_of("p_Bst").time, TIME)
    np.testing.assert_array_equal(log.values("gear"), np.arange(50.0))
    np.testing.assert_array_equal(log.group_of("gear").time, TIME[:50])
    assert log.groups["ecu"].frame.height == 50
    assert "without a time vector of their length: odd" in log.facts["notes"][0]


def test_version_5(tmp_path: Path) -> None:
    path = tmp_path / "x.mat"
    ecu = {"time": TIME[:50], "gear": np.arange(50, dtype=np.uint8)}
    matrix = np.column_stack([VALUES, -VALUES])
    top = {"t": TIME[:, None], "p_Bst": VALUES[None, :], "m": matrix, "odd": np.arange(7), "ecu": ecu}
    savemat(path, {**top, "name": "bench"}, do_compression=True)
    log = read_log(path)
    check(log)
    np.testing.assert_array_equal(log.values("m[1]"), -VALUES)
    head = read_header(path)
    assert (head.signals, head.facts["rows"]) == (log.signals, {"data": 200, "ecu": 50})


def test_simulink_structure_with_time(tmp_path: Path) -> None:
    path = tmp_path / "x.mat"
    savemat(path, {"out": {"time": TIME, "signals": {"values": VALUES, "label": "p_Int"}}})
    log = read_log(path)
    np.testing.assert_array_equal(log.values("p_Int"), VALUES)
    assert list(log.groups) == ["out"]


def write_7_3(path: Path) -> Path:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (("t", TIME), ("p_Bst", VALUES), ("odd", np.arange(7.0))):
            data = file.create_dataset(
                name, data=values[None, :], compression="gzip", shuffle=True, fletcher32=True
            )
            data.attrs["MATLAB_class"] = np.bytes_("double")
        ecu = file.create_group("ecu")
        ecu["time"], ecu["gear"] = TIME[None, :50], np.arange(50, dtype=np.uint8)[None, :]
        word = file.create_dataset("name", data=np.frombuffer(b"bench", np.uint8).astype(np.uint16)[None, :])
        word.attrs["MATLAB_class"] = np.bytes_("char")
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\2IM")
    return path


def test_version_7_3(tmp_path: Path) -> None:
    check(read_log(write_7_3(tmp_path / "x.mat")))


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_damage_is_told(tmp_path: Path, version: str) -> None:
    path = tmp_path / "x.mat"
    if version == "5":
        savemat(path, {"t": TIME, "p_Bst": VALUES}, do_compression=True)
    else:
        write_7_3(path)
    good, told = path.read_bytes(), 0
    for cut in (len(good) * 3 // 5, len(good) - 40, 600 if version == "7.3" else 130):
        path.write_bytes(good[:cut])
        with pytest.raises(LogError, match=r"x\.mat: (damaged MATLAB|no )"):
            read_log(path)
    for at in range(200, len(good), 211):
        path.write_bytes(good[:at] + bytes([good[at] ^ 0xFF]) + good[at + 1 :])
        try:
            log = read_log(path)
        except LogError:
            told += 1
        else:  # the format does not guard its names
            if "p_Bst" in log.signals:
                np.testing.assert_array_equal(log.values("p_Bst"), VALUES)
    assert told > 3


def test_nothing_in_it(tmp_path: Path) -> None:
    savemat(tmp_path / "x.mat", {"a": "text"})
    with pytest.raises(LogError, match="no numeric vector in a"):
        read_log(tmp_path / "x.mat")
    savemat(tmp_path / "x.mat", {"p_Bst": VALUES})
    with pytest.raises(LogError, match="no time column"):
        read_log(tmp_path / "x.mat")


def test_a_size_that_no_memory_holds(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "x.mat", "w") as file:
        file.create_dataset("t", shape=(1 << 42,), dtype="f8", chunks=(1024,))
    with pytest.raises(LogError, match=r"declares 4398046511104 rows .* damaged, or must be split"):
        read_log(tmp_path / "x.mat")
