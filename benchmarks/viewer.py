"""What a timeline costs: its size, and the time to write it, to open it and to draw it.

    python -m benchmarks.viewer [--rows 2000000] [--signals 40] [--part 1 2 3]

Part 1: a log of 40 signals x 2 million rows (10 kHz, 200 s, noise on waves, an event) as its recording, all
signals of one unit, then each of its own: bytes, seconds to write, to open, until the picture of the first
tab no longer changes, then that of each tab; drawn by Mesa's software Vulkan driver.
Part 2: bytes a value of a recording that keeps every value, one signal to a plot: a simulated drive with its
truth, noise of 32 and of 64 bits; without the layout, whose size does not depend on the log's length.
Part 3: an hour of recipe `diesel_airpath` with its run: recording and report, bytes and seconds, beside
the time that reading and diagnosing it take in the same process.

Times of part 1 are of the wall, of part 3 of the processor; both depend on what else the machine does: read
them as ratios.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import polars as pl

from ingest.log import Event, Group, Log, Signal
from viz.render import opened, settled, tabs, viewer
from viz.timeline import write_log_timeline

LIMITS = {"MB": 30.0, "s to open": 3.0, "s to draw": 20.0, "bytes a value": 9.0}


def wide(rows: int, signals: int, rate: float = 10_000.0) -> Log:
    """Noise on slow ramps, peaks of one sample, and an injected fault in the middle."""
    rng = np.random.default_rng(1)
    t = np.arange(rows) / rate
    columns = {}
    for i in range(signals):
        values = np.sin(t / (3.0 + i)) + 0.05 * rng.standard_normal(rows)
        values[rng.integers(0, rows, 3)] += 2.0
        columns[f"x{i:02d}"] = values
    event = Event(t_start=float(t[rows // 2]), kind="sensor_offset", source="truth", channel="x00")
    return Log(
        name="wide", groups={"fast": Group("fast", pl.DataFrame({"time": t, **columns}))}, events=(event,)
    )


def with_units(log: Log, unit: str | None) -> Log:
    """The same with ``unit`` for all signals; None: with one of its own for each."""
    groups = {
        k: replace(g, signals={n: Signal(name=n, unit=unit or n) for n in g.frame.columns if n != "time"})
        for k, g in log.groups.items()
    }
    return replace(log, groups=groups)


def line(name: str, value: float, limit: float | None = None) -> None:
    said = (
        "" if limit is None else f"   wanted at most {limit:g}{'' if value <= limit else ': DOES NOT HOLD'}"
    )
    print(f"  {name:44} {value:10.3g}{said}", flush=True)


def part_1(folder: Path, rows: int, signals: int) -> None:
    log = wide(rows, signals)
    for told, unit in (("all of one unit", "V"), ("each of a unit, so a plot, of its own", None)):
        print(f"1. {signals} signals x {rows} rows, {told}")
        _open_and_draw(with_units(log, unit), folder / "wide.rrd")


def _open_and_draw(log: Log, path: Path) -> None:
    began = time.perf_counter()
    write_log_timeline(log, path)
    line("s to write", time.perf_counter() - began)
    line("MB", path.stat().st_size / 1e6, LIMITS["MB"])
    with viewer() as client:
        began = time.perf_counter()
        opened(client, path)
        line("s to open", time.perf_counter() - began, LIMITS["s to open"])
        settled(client)
        line("s to draw the first tab", time.perf_counter() - began, LIMITS["s to draw"])
        for name in tabs(client):
            began = time.perf_counter()
            settled(client)
            line(f"s to draw the tab {name}", time.perf_counter() - began, LIMITS["s to draw"])


def part_2(folder: Path) -> None:
    from ingest.simulators.airpath import simulate_airpath

    rows = 50_000
    print(f"2. every value kept, one signal to a plot, {rows} rows; a drive of 1370 s")
    logs = {"a simulated drive": simulate_airpath(cycle="udds", seed=1)}
    for signals, kind in ((14, pl.Float32), (14, pl.Float64), (16, pl.Float64), (40, pl.Float64)):
        log = with_units(wide(rows, signals), None)
        (group,) = log.groups.values()
        frame = group.frame.with_columns(pl.exclude("time").cast(kind))
        logs[f"{signals} signals of noise, {kind()}"] = replace(
            log, groups={"fast": replace(group, frame=frame)}
        )
    for name, log in logs.items():
        short = replace(log, groups={k: replace(g, frame=g.frame.head(2)) for k, g in log.groups.items()})
        sizes = []
        for one in (log, short):
            write_log_timeline(one, folder / "full.rrd")
            sizes.append((folder / "full.rrd").stat().st_size)
        values = sum(g.frame.height * len(g.signals) for g in log.groups.values())
        line(f"bytes a value, {name}", (sizes[0] - sizes[1]) / values, LIMITS["bytes a value"])
        line("kB of its layout", sizes[1] / 1e3)


def part_3(folder: Path) -> None:
    from ingest import read_log, write_log
    from ingest.simulators.airpath import simulate_airpath
    from ingest.simulators.faults import Fault
    from pipeline import diagnose, fit, load_recipe
    from pipeline.manifest import build_manifest
    from pipeline.outputs import write_run
    from pipeline.reporting import write_report

    print("3. two WLTC drives of half an hour as one log, with a leak, recipe diesel_airpath")
    drives = [simulate_airpath(cycle="wltc_3b", seed=s, name=f"d{s}") for s in (1, 2, 3)]
    detector = fit(drives[:1], load_recipe("diesel_airpath"), drives[1:2])
    first, second = (
        simulate_airpath(cycle="wltc_3b", seed=s, faults=[Fault(name="boost_leak", magnitude=6.0)])
        for s in (8, 9)
    )
    shift = first.span[1] + 0.02
    groups = {
        k: replace(g, frame=pl.concat([g.frame, second.groups[k].frame.with_columns(pl.col("time") + shift)]))
        for k, g in first.groups.items()
    }
    path = write_log(replace(first, name="hour", groups=groups), folder / "hour.parquet")
    diagnose(read_log(path), detector)  # compiles what is compiled
    began = time.process_time()
    log = read_log(path)
    diagnosis = diagnose(log, detector)
    diagnosed = time.process_time() - began
    line("cpu s to read and diagnose", diagnosed)
    manifest = build_manifest(log, detector, "key", {})
    seconds = {}
    for timeline in (False, True):
        began = time.process_time()
        write_run(diagnosis, folder / "out" / "hour", manifest, timeline=timeline)
        seconds[timeline] = time.process_time() - began
    line("cpu s to write the run without timeline", seconds[False])
    line("cpu s to write the timeline", seconds[True] - seconds[False])
    line("MB of the timeline", (folder / "out/hour/timeline.rrd").stat().st_size / 1e6, LIMITS["MB"])
    write_report(folder / "out/hour")
    (folder / "out/hour/report.html").unlink()
    began = time.process_time()
    page = write_report(folder / "out/hour")
    line("cpu s to draw the report of it", time.process_time() - began)
    line("kB of the report of it", page.stat().st_size / 1e3)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", type=int, default=2_000_000)
    parser.add_argument("--signals", type=int, default=40)
    parser.add_argument("--part", type=int, nargs="+", default=[1, 2, 3], choices=(1, 2, 3))
    args = parser.parse_args()
    with TemporaryDirectory(prefix="dynoscope-") as name:
        if 1 in args.part:
            part_1(Path(name), args.rows, args.signals)
        if 2 in args.part:
            part_2(Path(name))
        if 3 in args.part:
            part_3(Path(name))


if __name__ == "__main__":
    main()
