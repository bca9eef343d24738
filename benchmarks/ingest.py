"""How fast logs are read and written, as ratios to what cannot be avoided, measured side by side.

``python -m benchmarks.ingest [--rows N] [--big]`` at the top of the repository; ``--big`` adds files of
1.3 GB, for memory and headers. A ratio is the median over rounds in which both sides ran one after the other,
of the time on the wall, which is judged, and of the time of all processors, which others change less.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
import pyarrow.parquet as pq
import zstandard

from ingest import read_log, write_log
from ingest.convert import convert
from ingest.files import read_blocks
from ingest.log import Log
from ingest.mcap_reader import chunks, open_mcap

SIGNALS = 40
ROUNDS = 5


class Took(NamedTuple):
    """Time on the wall and of the processors, s; or ratios of them."""

    wall: float
    cpu: float


def took(work: Callable[[], Any]) -> Took:
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return Took(time.perf_counter() - wall, time.process_time() - cpu)


def ratio(ours: Callable[[], Any], theirs: Callable[[], Any], rounds: int = ROUNDS) -> Took:
    """Median of ``ours / theirs``, after each has run once: what is imported then is not counted."""
    ours(), theirs()
    pairs = [(took(ours), took(theirs)) for _ in range(rounds)]
    return Took(
        statistics.median(a.wall / b.wall for a, b in pairs),
        statistics.median(a.cpu / b.cpu for a, b in pairs),
    )


def show(what: str, found: str, target: str, holds: bool) -> None:
    print(f"{what:<64} {found:>20}   {target:<14} {'holds' if holds else 'DOES NOT HOLD'}", flush=True)


def at_most(what: str, found: Took, most: float) -> None:
    show(what, f"{found.wall:.2f} (cpu {found.cpu:.2f})", f"<= {most:g}", found.wall <= most)


def at_least(what: str, found: Took, least: float) -> None:
    """``found`` is our share of their time."""
    times = 1 / found.wall
    show(what, f"{times:.1f} (cpu {1 / found.cpu:.1f})", f">= {least:g}", times >= least)


def frame_of(rows: int, first: int = 0) -> pl.DataFrame:
    """Values like those of a bench: about 14 bits and noise, hard to compress."""
    rng = np.random.default_rng(first)
    columns = {"time": np.arange(first, first + rows) * 0.01}
    for i in range(SIGNALS):
        walk = np.cumsum(rng.normal(size=rows)) + rng.normal(size=rows)
        columns[f"s{i:02d}"] = (np.round(walk * 50) / 50).astype(np.float32)
    return pl.DataFrame(columns)


def csv_ratios(folder: Path, frame: pl.DataFrame) -> None:
    clean, dirty = folder / "clean.csv", folder / "dirty.csv"
    frame.write_csv(clean)
    at_most(
        "CSV -> Log / polars.read_csv, clean", ratio(lambda: read_log(clean), lambda: pl.read_csv(clean)), 1.3
    )
    body = frame.write_csv(separator=";", include_header=False, decimal_comma=True)
    lines = body.splitlines()
    lines[len(lines) // 2] = "ERR;" + ";".join(["---"] * (SIGNALS // 2)) + ";" * (SIGNALS - SIGNALS // 2)
    head = "Prüfstand 4\n" + ";".join(frame.columns) + "\n" + ";".join(["s"] + ["kPa"] * SIGNALS) + "\n"
    dirty.write_bytes((head + "\n".join(lines) + "\n").encode("latin-1"))
    at_most(
        "CSV -> Log / polars.read_csv of the clean file, dirty",
        ratio(lambda: read_log(dirty), lambda: pl.read_csv(clean)),
        3.0,
    )


def command_ratio(folder: Path, log: Log) -> None:
    source, out = folder / "clean.csv", folder / "out"
    content = mcap_content(write_log(log, folder / "parts.mcap"))
    table = log.groups["data"].frame.to_arrow()

    def parts() -> None:
        pl.read_csv(source)
        for chunk in content:
            zstandard.compress(chunk, 1)
        pq.write_table(table, folder / "parts.parquet", compression="zstd")

    work = ratio(lambda: convert(read_blocks(source), out, "x"), parts, 3)
    at_most("ingest / (parse + zstd of the MCAP + Parquet)", work, 1.5)


def mcap_content(path: Path) -> list[bytes]:
    return [bytes(chunk) for chunk in chunks(open_mcap(path))]


def mcap_ratios(folder: Path, log: Log) -> None:
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory
    from mcap_protobuf.writer import Writer

    path, theirs = folder / "ours.mcap", folder / "theirs.mcap"
    write_log(log, path)
    content = mcap_content(path)
    at_most(
        "MCAP write / zstd of its bytes, one thread",
        ratio(lambda: write_log(log, path), lambda: [zstandard.compress(c, 1) for c in content]),
        1.5,
    )
    with path.open("rb") as stream:
        decoded = make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages(["/data"])
        kind: Any = type(next(iter(decoded)).decoded_message)
    names = log.groups["data"].frame.columns
    frame = log.groups["data"].frame

    def write() -> None:
        with theirs.open("wb") as stream, Writer(stream) as writer:
            for i, row in enumerate(frame.iter_rows(named=True)):
                writer.write_message("/data", kind(**row), i, i)

    def read() -> None:
        with theirs.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
            rows = [[getattr(m.decoded_message, c) for c in names] for m in reader.iter_decoded_messages()]
            pl.DataFrame(np.array(rows), schema=names)

    at_least(
        "MCAP write, times faster than mcap-protobuf-support",
        ratio(lambda: write_log(log, path), write, 2),
        6,
    )
    at_least("MCAP read, times faster than mcap-protobuf-support", ratio(lambda: read_log(path), read, 2), 20)


def mdf_ratio(folder: Path, frame: pl.DataFrame) -> None:
    from asammdf import MDF

    path = write_mdf(folder / "x.mf4", [frame])

    def select() -> None:
        with MDF(path) as file:
            file.select([(None, 0, i) for i in range(1, SIGNALS + 1)], copy_master=False)

    at_most("MDF4 -> Log / asammdf select", ratio(lambda: read_log(path), select), 1.5)


def write_mdf(path: Path, frames: list[pl.DataFrame]) -> Path:
    from asammdf import MDF, Signal

    with MDF(version="4.10") as file:
        for number, frame in enumerate(frames):
            time_stamps = frame["time"].to_numpy()
            samples = [(frame[f"s{i:02d}"].to_numpy(), f"s{i:02d}") for i in range(SIGNALS)]
            if number:
                file.extend(0, [(time_stamps, None), *((values, None) for values, _ in samples)])
            else:
                file.append([Signal(v, time_stamps, name=n, unit="kPa") for v, n in samples], acq_name="ecu")
        file.save(path, overwrite=True, compression=0)
    return path


def big_files(folder: Path) -> None:
    """Memory of the command on files of 1.3 GB beyond that of the bare interpreter, and headers."""
    rows, part = 0, 200_000
    csv = folder / "big.csv"
    with csv.open("wb") as stream:
        while stream.tell() < 1.3e9:
            frame_of(part, rows).write_csv(stream, include_header=rows == 0)
            rows += part
    frames = [frame_of(part, n * part) for n in range(int(1.3e9 / (part * (4 * SIGNALS + 8))) + 1)]
    mdf = write_mdf(folder / "big.mf4", frames)
    bare = _peak(["-c", "pass"])
    for path in (csv, mdf):
        began = time.perf_counter()
        peak = _peak(["-m", "pipeline.cli", "ingest", str(path), "--out", str(folder / "out")]) - bare
        found = f"{peak:.0f} MB ({time.perf_counter() - began:.0f} s)"
        show(
            f"ingest of {path.stat().st_size / 1e9:.1f} GB {path.suffix}: memory",
            found,
            "< 700 MB",
            peak < 700,
        )
        look = ["-m", "pipeline.cli", "inspect", str(path), "--json"]
        took_s = min(took(partial(_peak, look)).wall for _ in range(3))
        show(
            f"inspect of its header, {path.suffix}, with the start of Python",
            f"{took_s:.2f} s",
            "< 1 s",
            took_s < 1,
        )


def _peak(arguments: list[str]) -> float:
    """Largest resident size in MB of a Python process and its children."""
    code = (
        "import resource, subprocess, sys; subprocess.run([sys.executable, *sys.argv[1:]], check=True, "
        "stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL); "
        "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True
    )
    return float(done.stdout) / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=200_000)
    parser.add_argument("--big", action="store_true")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        frame = frame_of(args.rows)
        csv_ratios(folder, frame)
        log = read_log(folder / "clean.csv")
        command_ratio(folder, log)
        mcap_ratios(folder, log)
        mdf_ratio(folder, frame)
        if args.big:
            big_files(folder)


if __name__ == "__main__":
    main()
