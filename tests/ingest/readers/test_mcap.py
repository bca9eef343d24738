from __future__ import annotations

import json
import math
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import zstandard
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import MCAP0_MAGIC, CompressionType, IndexType, Writer
from mcap_protobuf.decoder import DecoderFactory
from mcap_protobuf.schema import build_file_descriptor_set

from ingest import read_log, write_log
from ingest.errors import LogError
from ingest.files import read_header
from ingest.log import Event, Group, Log, Signal
from ingest.maps import NameMap, TimeMap


def make_log(rows: int = 400) -> Log:
    rng = np.random.default_rng(1)
    time = np.arange(rows) * 0.02 - 1.0
    ecu = pl.DataFrame({"time": time, "p_Bst": rng.normal(150, 5, rows), "x.y": rng.normal(size=rows)})
    ecu = ecu.with_columns(
        pl.col("x.y").cast(pl.Float32), gear=pl.Series(rng.integers(1, 6, rows), dtype=pl.Int8)
    )
    slow = pl.DataFrame({"time": time[::10], "mode": ["idle", None] * (rows // 20), "n": range(rows // 10)})
    events = (
        Event(t_start=2.0, t_end=5.0, kind="maf_gain", source="truth", magnitude=0.05, unit="1"),
        Event(t_start=3.0, kind="gap", source="quality", channel="p_Bst"),
    )
    groups = {
        "ecu": Group("ecu", ecu, {"p_Bst": Signal(name="p_Bst", unit="kPa")}),
        "slow": Group("slow", slow),
    }
    return Log("drive", groups, events, {"seed": 1, "vehicle": "v"})


@pytest.fixture(scope="module")
def log() -> Log:
    return make_log()


@pytest.fixture(scope="module")
def path(log: Log, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(log, tmp_path_factory.mktemp("mcap") / "x.mcap")


@pytest.mark.parametrize("reader", [make_reader, NonSeekingReader])
def test_official_reader_finds_every_value(path: Path, log: Log, reader: Callable[..., Any]) -> None:
    found: dict[str, list[dict[str, Any]]] = {}
    with path.open("rb") as stream:
        official = reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message in official.iter_messages(log_time_order=False):
            if channel.message_encoding == "json":
                found.setdefault(channel.topic, []).append(json.loads(message.data))
                assert message.log_time == round((found[channel.topic][-1]["t_start"] + 1.0) * 1e9)
    with path.open("rb") as stream:
        official = reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        topics = [f"/{g}" for g in log.groups]
        for _, channel, message, row in official.iter_decoded_messages(topics, log_time_order=False):
            assert message.log_time == round((row.time + 1.0) * 1e9), "shifted: the log begins at -1 s"
            given = {f.name: getattr(row, f.name) for f in row.DESCRIPTOR.fields if row.HasField(f.name)}
            found.setdefault(channel.topic, []).append(given)
    for name, group in log.groups.items():
        rows = found[f"/{name}"]
        assert len(rows) == group.frame.height
        for row, expected in zip(rows, group.frame.to_dicts(), strict=True):
            assert row == {k.replace(".", "_"): v for k, v in expected.items() if v is not None}
    assert [Event(**e) for e in found["/events"]] == list(log.events)


def test_metadata_for_others(path: Path) -> None:
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        channels = {c.topic: c for c in summary.channels.values()}
        assert channels["/ecu"].metadata["unit.p_Bst"] == "kPa"
        assert channels["/ecu"].metadata["name.x_y"] == "x.y"
        assert summary.statistics is not None
        assert summary.statistics.message_count == 400 + 40 + 2
        assert all(i.message_index_offsets for i in summary.chunk_indexes)
        *_, record = reader.iter_metadata()
        assert json.loads(record.metadata["log"])["facts"] == {"seed": 1, "vehicle": "v"}


@pytest.mark.skipif(
    not shutil.which("rerun", path=Path(sys.executable).parent), reason="no rerun command here"
)
def test_the_doctor_of_another_implementation_agrees(path: Path) -> None:
    command = [str(Path(sys.executable).with_name("rerun")), "mcap", "check", "--full", str(path)]
    checked = subprocess.run(command, capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr
    assert checked.stdout.count("\nok ") == 3, checked.stdout


def test_missing_numbers_are_nan_on_the_wire_and_null_again(tmp_path: Path) -> None:
    frame = pl.DataFrame({"time": [0.0, 1.0], "a": pl.Series([None, 3], dtype=pl.UInt16)})
    path = write_log(Log("x", {"g": Group("g", frame)}), tmp_path / "x.mcap")
    with path.open("rb") as stream:
        rows = make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        values = [r.decoded_message.a for r in rows]
    assert math.isnan(values[0])
    assert values[1] == 3.0
    assert read_log(path).groups["g"].frame.equals(frame)


def is_part(part: Log, whole: Log) -> bool:
    """Whether every row of ``part`` is one of ``whole``, in order."""
    for key, group in part.groups.items():
        rows = iter(whole.groups[key].frame.rows())
        if dict(group.signals) != dict(whole.groups[key].signals) or any(
            r not in rows for r in group.frame.rows()
        ):
            return False
    return set(part.events) <= set(whole.events)


def test_a_wrong_byte_is_never_wrong_data(path: Path, log: Log, tmp_path: Path) -> None:
    good, bad = path.read_bytes(), tmp_path / "bad.mcap"
    told = 0
    for at in range(8, len(good), 29):
        bad.write_bytes(good[:at] + bytes([good[at] ^ 0xA5]) + good[at + 1 :])
        try:
            back = read_log(bad)
        except LogError:
            told += 1
            continue
        assert is_part(back, log), f"byte {at}"
        if "salvaged" in back.facts:
            told += 1
        else:
            assert back.equals(log), f"byte {at}: unharmed, or told"
    assert told > 100


def test_a_damaged_chunk_costs_only_its_rows(tmp_path: Path) -> None:
    frame = pl.DataFrame(
        {"time": np.arange(60_000) * 0.01, "a": np.random.default_rng(0).normal(size=60_000)}
    )
    log = Log("x", {"g": Group("g", frame)}, (), {"seed": 1})
    path = write_log(log, tmp_path / "x.mcap")
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    second = summary.chunk_indexes[1]
    data = bytearray(path.read_bytes())
    data[second.chunk_start_offset + second.chunk_length // 2] ^= 1
    path.write_bytes(data)
    back = read_log(path)
    lost = frame.height - back.groups["g"].frame.height
    assert 0 < lost < frame.height / 2
    assert is_part(back, log)
    assert f"the chunk at byte {second.chunk_start_offset} is damaged" in back.facts["salvaged"][0]
    assert back.facts["seed"] == 1


def test_any_cut_gives_a_part(path: Path, log: Log, tmp_path: Path) -> None:
    good, cut = path.read_bytes(), tmp_path / "cut.mcap"
    heights = set()
    for end in [*range(0, len(good) - 1, 97), len(good) - 1]:
        cut.write_bytes(good[:end])
        try:
            back = read_log(cut)
        except LogError as error:
            assert "cut.mcap" in str(error)  # noqa: PT017 - whether it is raised depends on the cut
            continue
        assert is_part(back, log)
        assert back.facts["salvaged"]
        heights.add(sum(g.frame.height for g in back.groups.values()))
    assert max(heights) == 440, "all chunks are there before the summary begins"


def vehicle_message() -> Any:
    file = FileDescriptorProto(name="v.proto", package="acme", syntax="proto3")
    inner = file.message_type.add(name="Inner")
    inner.field.add(name="rpm", number=1, type=FieldDescriptorProto.TYPE_DOUBLE, label=1)
    inner.field.add(name="blob", number=2, type=FieldDescriptorProto.TYPE_BYTES, label=1)
    outer = file.message_type.add(name="Outer")
    outer.field.add(
        name="engine", number=1, type=FieldDescriptorProto.TYPE_MESSAGE, type_name=".acme.Inner", label=1
    )
    outer.field.add(name="p_Bst", number=2, type=FieldDescriptorProto.TYPE_FLOAT, label=1)
    outer.field.add(name="list", number=3, type=FieldDescriptorProto.TYPE_INT32, label=3)
    outer.field.add(name="ok", number=4, type=FieldDescriptorProto.TYPE_BOOL, label=1)
    pool = DescriptorPool()
    pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName("acme.Outer"))


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("indexed", [True, False])
def test_files_of_others(tmp_path: Path, compression: CompressionType, indexed: bool) -> None:
    start = 1_700_000_000_000_000_000
    message = vehicle_message()
    path = tmp_path / "theirs.mcap"
    with path.open("wb") as stream:
        writer = Writer(
            stream,
            compression=compression,
            index_types=IndexType.ALL if indexed else IndexType.NONE,
            use_chunking=indexed or compression != CompressionType.NONE,
        )
        writer.start()
        data = build_file_descriptor_set(message).SerializeToString()
        schema = writer.register_schema("acme.Outer", "protobuf", data)
        topics = [("/car", "protobuf", schema), ("/env", "json", 0), ("/cdr", "cdr", 0)]
        car, env, cdr = (writer.register_channel(*t) for t in topics)
        for i in range(50):
            row = message(p_Bst=float(i), list=[1, 2], ok=bool(i % 2))
            if i:
                row.engine.rpm = 1000.0 + i
            stamp = start + i * 20_000_000
            writer.add_message(car, stamp, row.SerializeToString(), stamp)
            weather = {"T": {"in": i, "out": 1.5} if i != 7 else {}, "p_Bst": 3, "tags": ["a"]}
            writer.add_message(env, stamp + 5, json.dumps(weather).encode(), stamp)
        writer.add_message(cdr, start, b"\0", start)
        writer.finish()  # type: ignore[no-untyped-call]
    log = read_log(path)
    car_frame, env_frame = log.groups["car"].frame, log.groups["env"].frame
    assert car_frame.columns == ["time", "car.p_Bst", "ok", "engine.rpm"], "p_Bst is in two channels"
    assert car_frame["time"].to_list() == [i * 20 / 1000 for i in range(50)]
    assert car_frame["engine.rpm"].to_list() == [None, *(1000.0 + i for i in range(1, 50))]
    assert car_frame["ok"].to_list() == [bool(i % 2) for i in range(50)]
    assert env_frame["T.in"].to_list() == [i if i != 7 else None for i in range(50)]
    assert env_frame["env.p_Bst"].to_list() == [3] * 50
    assert log.facts["start_time"].startswith("2023-11-14T22:13:20")
    assert "channel /cdr was skipped: encoding 'cdr'" in log.facts["notes"][0]
    assert log.facts["format"] == "mcap"
    head = read_header(path, NameMap())
    assert list(head.signals) == list(log.signals)
    assert head.facts["rows"] == {"car": 50, "env": 50, "cdr": 1}


def test_time_of_others_by_map(tmp_path: Path) -> None:
    path = tmp_path / "theirs.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/a", "json", 0)
        for i in range(3):
            writer.add_message(channel, 0, json.dumps({"clock": i * 100, "x": i}).encode(), 0)
        writer.finish()  # type: ignore[no-untyped-call]
    log = read_log(path, NameMap(time=TimeMap(source=("clock",), unit="ms")))
    assert log.groups["a"].frame.rows() == [(0.0, 0), (0.1, 1), (0.2, 2)]


def test_our_rows_in_chunks_that_another_tool_mixed(tmp_path: Path, log: Log, path: Path) -> None:
    """As ``mcap sort`` or ``merge`` leave them: channels interleaved by log time, in larger chunks."""
    mixed = tmp_path / "mixed.mcap"
    with path.open("rb") as source, mixed.open("wb") as stream:
        reader = make_reader(source)
        writer = Writer(stream, chunk_size=10_000)
        writer.start()
        ids: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.id not in ids:
                new = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, new, channel.metadata
                )
            writer.add_message(ids[channel.id], message.log_time, message.data, message.publish_time)
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        writer.finish()  # type: ignore[no-untyped-call]
    assert read_log(mixed).equals(log)


def test_what_is_no_mcap(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(LogError, match=r"x\.mcap: nothing can be read"):
        read_log(path)
    path.write_bytes(b"\x89MCAP1\r\n")
    with pytest.raises(LogError, match=r"not a log of a known format \(mcap, .*csv\)"):
        read_log(path)


def test_ros_2(tmp_path: Path) -> None:
    writer_of = pytest.importorskip("mcap_ros2.writer")
    path = tmp_path / "ros.mcap"
    text = "float64 boost\ngeometry_msgs/Point at\nint32[] list\nbool ok\n" + "=" * 40
    text += "\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\n"
    with path.open("wb") as stream:
        writer = writer_of.Writer(stream)
        schema = writer.register_msgdef("acme/msg/Engine", text)
        for i in range(20):
            row = {"boost": float(i), "at": {"x": i / 2, "y": 1.0}, "list": [1], "ok": bool(i % 2)}
            writer.write_message("/engine", schema, row, i * 10_000_000, i * 10_000_000)
        writer.finish()
    frame = read_log(path).groups["engine"].frame
    assert frame.columns == ["time", "boost", "at.x", "at.y", "ok"]
    assert frame["boost"].to_list() == [float(i) for i in range(20)]
    assert frame["at.x"].to_list() == [i / 2 for i in range(20)]
    assert frame["time"].to_list() == [i / 100 for i in range(20)]


def test_attachments(tmp_path: Path, log: Log) -> None:
    path = write_log(log, tmp_path / "x.mcap", {"report.json": b"{}", "map.toml": b"x = 1"})
    assert read_log(path).equals(log)
    with path.open("rb") as stream:
        found = {a.name: (a.media_type, a.data) for a in make_reader(stream).iter_attachments()}
    assert found == {
        "report.json": ("application/json", b"{}"),
        "map.toml": ("application/toml", b"x = 1"),
    }


def test_a_chunk_that_claims_to_be_huge_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "bomb.mcap"
    bomb = zstandard.compress(bytes(1 << 27), 19)
    head = struct.pack("<QQQII", 0, 0, 1 << 45, 0, 4) + b"zstd" + struct.pack("<Q", len(bomb))
    content = head + bomb
    record = struct.pack("<BQ", Opcode.CHUNK, len(content)) + content
    path.write_bytes(MCAP0_MAGIC + struct.pack("<BQII", Opcode.HEADER, 8, 0, 0) + record)
    with pytest.raises(LogError, match=r"bomb\.mcap: nothing can be read.*unpacked 35184372088832 bytes"):
        read_log(path)
