"""What batches withstand and what they cost.

``python -m benchmarks.batch [--part N ...] [--drives N]`` at the top of the repository, on two idle cores.
Ratios are of times in one run, on the wall or of the processors (cpu), which others change less.
"""

from __future__ import annotations

import os

for variable in ("POLARS_MAX_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(variable, "1")  # what is measured is one core

import argparse
import json
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from benchmarks.batch_drives import (
    FAULTS,
    RECIPE,
    damage,
    detector,
    drive,
    repeated,
    thin,
    write_drives,
)
from benchmarks.ingest import show, took
from ingest import read_log, write_log
from pipeline import run
from pipeline.batch import Options
from pipeline.detector import Detector
from pipeline.diagnosing import diagnose
from pipeline.outputs import write_run
from pipeline.summary import Summary
from stages.stage import transform

PLAIN = Options(timeline=False, force=True)
DAMAGED = 10
RESULTS = ("summary.parquet", "summary.csv", "fleet.csv", "vehicles.json")


def crashes(folder: Path, known: Detector, count: int) -> None:
    """Part 1: a batch that is killed three times, and its workers, against one that is left alone."""
    drives = folder / "drives"
    drives.mkdir()
    for i in range(count):
        path = write_log(drive(i, 300.0), drives / f"drive{i:03d}{('.mcap', '.parquet')[i % 2]}")
        if i < DAMAGED:
            damage(path, i)
    undisturbed, disturbed = folder / "undisturbed", folder / "disturbed"
    whole = took(lambda: command(drives, folder, undisturbed).wait()).wall
    dice = random.Random(7)
    for _ in range(3):
        main = command(drives, folder, disturbed)
        time.sleep(dice.uniform(0.15, 0.35) * whole)
        workers = children(main.pid)
        if workers:
            os.kill(dice.choice(workers), signal.SIGKILL)
            time.sleep(0.5)
        main.kill()
        main.wait()
        so_far = pl.read_parquet(disturbed / "summary.parquet")
        print(f"  killed with {so_far.height} of {count} logs in the summary")
    main = command(drives, folder, disturbed)
    time.sleep(0.1 * whole)
    for worker in children(main.pid):
        os.kill(worker, signal.SIGKILL)
    main.wait()
    same = all((undisturbed / n).read_bytes() == (disturbed / n).read_bytes() for n in RESULTS)
    show("killed three times, and workers: the same, byte for byte", str(same), "True", same)
    found = pl.read_parquet(undisturbed / "summary.parquet")
    print(found.group_by("status").len().sort("status"))
    print(found.filter(pl.col("status") != "ok").select("log", "status", "reason").head(DAMAGED))
    good = found.filter(pl.col("log") >= f"drive{DAMAGED:03d}")
    bad = found.filter(pl.col("log") < f"drive{DAMAGED:03d}", pl.col("status") != "ok")
    done = (good["status"] == "ok").all() and good.height == count - DAMAGED
    show("all good logs done", f"{(good['status'] == 'ok').sum()} of {good.height}", "all", bool(done))
    show("all damaged logs reported", f"{bad.height} of {DAMAGED}", "all", bad.height == DAMAGED)
    named = good.select((pl.col("fault") == pl.col("truth").fill_null("none")).mean()).item()
    print(f"  faults named rightly, for the record: {named:.0%} of drives of 5 minutes")


def command(drives: Path, folder: Path, out: Path) -> subprocess.Popen[bytes]:
    words = ["run", drives, "--recipe", RECIPE, "--store", folder / "store", "--out", out, "--no-timeline"]
    words = [sys.executable, "-m", "pipeline.cli", *words, "--workers", "2"]
    return subprocess.Popen([str(w) for w in words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def children(pid: int) -> list[int]:
    """Worker processes of a batch."""
    found = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        found += [int(c) for c in (task / "children").read_text().split()]
    return [c for c in found if b"pipeline.engines" in Path(f"/proc/{c}/cmdline").read_bytes()]


def speed_up(folder: Path, known: Detector) -> None:
    """Part 2: two processes, and two workers of a cluster, against one."""
    few, many = 10, 60
    paths = write_drives(folder / "speed", many, 900.0, different=12)

    def seconds(options: Options) -> float:
        """For a log more, once the processes have started."""
        run(paths[:few], known, folder / "out", options)
        a, b = (took(lambda n=n: run(paths[:n], known, folder / "out", options)).wall for n in (few, many))
        return (b - a) / (many - few)

    one = seconds(PLAIN)
    two = seconds(replace(PLAIN, workers=2))
    show("two processes", f"{one / two:.2f} x one", ">= 1.7", one / two >= 1.7)
    with cluster(folder, 1) as address:
        one = seconds(replace(PLAIN, scheduler=address))
    with cluster(folder, 2) as address:
        two = seconds(replace(PLAIN, scheduler=address))
        show("two dask workers", f"{one / two:.2f} x one", ">= 1.6", one / two >= 1.6)
        dispatching(folder, known, replace(PLAIN, scheduler=address), "dask")
    dispatching(folder, known, replace(PLAIN, workers=2), "two processes")


def dispatching(folder: Path, known: Detector, options: Options, name: str) -> None:
    """What a log costs the process that hands them out and keeps the summary: of logs that are not there."""
    nothing = [folder / f"nothing{i:04d}.parquet" for i in range(1000)]
    run(nothing[:20], known, folder / f"dispatched {name}", options)
    spent = took(lambda: run(nothing, known, folder / f"dispatched {name}", options))
    print(
        f"  handing out a log, {name}: {spent.cpu:.2f} ms cpu of the main process, {spent.wall:.2f} ms in all"
    )


@contextmanager
def cluster(folder: Path, workers: int) -> Iterator[str]:
    """A scheduler and workers on loopback; the address."""
    known = Path(tempfile.mkdtemp(dir=folder)) / "scheduler.json"
    common = ["--scheduler-file", str(known), "--no-dashboard", "--host", "127.0.0.1"]

    def dask(*words: str) -> subprocess.Popen[bytes]:
        words = (sys.executable, "-m", f"distributed.cli.dask_{words[0]}", *common, *words[1:])
        return subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=known.parent)

    running = [dask("scheduler", "--port", "0")]
    running += [dask("worker", "--nthreads", "1", "--no-nanny") for _ in range(workers)]
    try:
        while not known.exists():
            time.sleep(0.1)
        time.sleep(5.0)
        yield json.loads(known.read_text())["address"]
    finally:
        for process in running:
            process.kill()
            process.wait()


def growth(folder: Path, known: Detector) -> None:
    """Part 3: the cost of one more log."""
    paths = write_drives(folder / "many", 1000, 60.0, different=20)
    run(paths[:5], known, folder / "warm", PLAIN)
    counts = (10, 100, 1000, 100, 10)  # before and after, so that a machine that becomes slower says nothing
    costs = [
        took(lambda n=n, i=i: run(paths[:n], known, folder / f"out{i}", PLAIN)) for i, n in enumerate(counts)
    ]
    for kind in ("cpu", "wall"):
        t = {
            n: statistics.mean(getattr(c, kind) for c, of in zip(costs, counts, strict=True) if of == n)
            for n in counts
        }
        few, many = (t[100] - t[10]) / 90, (t[1000] - t[100]) / 900
        what = f"a log more: {1e3 * few:.1f} ms from 10 to 100, {1e3 * many:.1f} from 100 to 1000 ({kind})"
        show(what, f"{many / few:.3f}", "0.9 .. 1.1", 0.9 <= many / few <= 1.1)
    summary(pl.read_parquet(folder / "out2" / "summary.parquet"), folder / "summaries")
    overhead(paths[0], known, folder)


def summary(rows: pl.DataFrame, out: Path, count: int = 10_000) -> None:
    """What a batch's tables of ``count`` logs, like those of ``rows``, take to write."""
    out.mkdir()
    names = [f"log{i:05d}" for i in range(count)]
    tables, known = Summary(out, names), rows.to_dicts()
    tables.rows = {name: {**known[i % len(known)], "log": name} for i, name in enumerate(names)}
    print(f"  the summary of {count} logs is written in {took(tables.write).wall:.2f} s")


def length(folder: Path) -> None:
    """Part 5: the cost of a longer log, and the memory it takes, with a fault all along."""
    hour = thin(drive(5, 3600.0))
    spent = {
        hours: measured(folder, repeated(hour, hours, folder / f"{hours}h.parquet")) for hours in (1, 20, 100)
    }
    cpu, mb = ({hours: x[kind] for hours, x in spent.items()} for kind in ("cpu", "mb"))
    ratio = cpu[100] / (100 * cpu[1])
    show(f"100 h at once: {cpu[100]:.0f} s cpu, 1 h: {cpu[1]:.2f}", f"{ratio:.2f}", "<= 1.2", ratio <= 1.2)
    what = f"memory: {mb[1]:.0f} MB for 1 h, {mb[20]:.0f} for 20 h, {mb[100]:.0f} for 100 h"
    show(what, f"{mb[100] / mb[20]:.2f}", "<= 1.15", mb[100] / mb[20] <= 1.15)


def overhead(path: Path, known: Detector, folder: Path) -> None:
    """What a log costs beside reading, mathematics and writing its files."""
    (folder / "copies").mkdir()
    copies = [folder / "copies" / f"c{i}.parquet" for i in range(50)]
    for copy in copies:
        copy.hardlink_to(path)
    whole = took(lambda: run(copies, known, folder / "copied", PLAIN)).wall / len(copies)

    def needed() -> None:
        diagnosis = diagnose(read_log(path), known)
        write_run(diagnosis, folder / "needed" / "x", {}, timeline=False)

    needed()
    least = statistics.median(took(needed).wall for _ in range(20))
    each = 1e3 * (whole - least)
    show("a log's overhead beside reading, diagnosing, writing", f"{each:.1f} ms", "<= 50", each <= 50)


def measured(folder: Path, path: Path) -> dict[str, float]:
    """CPU seconds and most memory of a log, in a process of its own, without what starting takes."""
    code = (
        "import json, resource, sys, time\n"
        "from pathlib import Path\n"
        "from benchmarks.batch import PLAIN\n"
        "from pipeline import run\n"
        "from pipeline.store import Store\n"
        "store, out, warm, path = map(Path, sys.argv[2:])\n"
        "known = Store(store).get(sys.argv[1])\n"
        "run([warm], known, out, PLAIN)\n"
        "began = time.process_time()\n"
        "run([path], known, out, PLAIN)\n"
        "print(json.dumps({'cpu': time.process_time() - began,\n"
        "    'mb': resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}))\n"
    )
    warm = write_log(thin(drive(1, 120.0)), folder / "warm.parquet")
    words = [RECIPE, folder / "store", folder / "measured", warm, path]
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, words)], capture_output=True, text=True, check=True
    )
    return dict(json.loads(done.stdout))


def end_to_end(folder: Path, known: Detector) -> None:
    """Part 4: ten hours' logs, half of them with a fault all along, against reading them and writing the same
    outputs, and against real time."""
    seconds, rounds = 3600.0, 5
    spent = np.array([worked(folder, known, seed, seconds, rounds) for seed in range(len(FAULTS))])
    for fault in dict.fromkeys(FAULTS):
        some = spent[[f == fault for f in FAULTS]].sum(axis=0)
        ratio, stages = np.median(some[:, 0] / some[:, 1], axis=0), np.median(some[:, 3, 1])
        print(
            f"  {' '.join(map(str, fault or ['none'])):27s} {ratio[0]:.2f} (wall), {ratio[1]:.2f} (cpu);"
            f" stages {stages / FAULTS.count(fault):.2f} s cpu a log"
        )
    all_of_them, whole_s = spent.sum(axis=0), seconds * len(FAULTS)
    for k, kind in enumerate(("wall", "cpu")):
        ratio = float(np.median(all_of_them[:, 0, k] / all_of_them[:, 1, k]))
        plain, timeline = (whole_s / float(np.median(all_of_them[:, i, k])) for i in (0, 2))
        show(f"without timeline, against reading and writing ({kind})", f"{ratio:.2f}", "<= 3", ratio <= 3)
        show(f"without timeline, times real time ({kind})", f"{plain:.0f}", ">= 2500", plain >= 2500)
        show(f"with timeline, times real time ({kind})", f"{timeline:.0f}", ">= 1200", timeline >= 1200)


def worked(folder: Path, known: Detector, seed: int, seconds: float, rounds: int) -> list[list[list[float]]]:
    """Wall and cpu seconds of each round: without timeline, of reading and writing, with timeline, of the
    stages."""
    path = write_log(thin(drive(seed, seconds)), folder / f"hour{seed}.parquet")
    log = read_log(path)
    diagnosis = diagnose(log, known)

    def floor() -> None:
        read_log(path)
        write_run(diagnosis, folder / "floor" / "x", {}, timeline=False)

    def ours(options: Options) -> Callable[[], Any]:
        return lambda: run([path], known, folder / "hours", options)

    stages = partial(transform, known.stages, log)
    works = ours(PLAIN), floor, ours(replace(PLAIN, timeline=True)), stages
    for work in works:
        work()
    spent = [[list(took(work)) for work in works] for _ in range(rounds)]
    made = sorted((folder / "hours" / path.stem).iterdir())
    sizes = ", ".join(f"{f.name} {f.stat().st_size / 1e6:.1f}" for f in (path, *made))
    print(f"  {diagnosis.verdict.fault}: MB of {sizes}")
    return spent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", type=int, nargs="+", default=[1, 2, 3, 4, 5])
    parser.add_argument("--drives", type=int, default=200, help="of part 1")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        known = detector(folder)
        print(f"load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
        if 1 in args.part:
            crashes(folder, known, args.drives)
        if 2 in args.part:
            speed_up(folder, known)
        if 3 in args.part:
            growth(folder, known)
        if 4 in args.part:
            end_to_end(folder, known)
        if 5 in args.part:
            length(folder)


if __name__ == "__main__":
    main()
