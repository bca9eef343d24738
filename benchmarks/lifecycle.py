"""The life of detectors, in figures.

    python -m benchmarks.lifecycle [domain] [poison] [comparison] [speed] [bench] [--seeds N] [--first N]
                                   [--hours H] [--folder FOLDER]

- domain: trained on UDDS, meets US06, before and after two US06 drives are added
- poison: sets of 20 drives with 10 % and 30 % faulty ones, sensors with tolerances per drive
- comparison: challengers that are as good, and beside the first such that are worse
- speed: CPU seconds of a fit, and of going on from it with 10 % more
- bench: the LiU-ICE logs in FOLDER (arXiv 2408.13269), fitted on the first half of the fault-free one,
  retrained with its third quarter, compared on its last; and with 4 regions, compared on its second half

All parts but `bench` if none is named. Seeds from 60000 were not tuned on. Every line says how many drives or
sets it counts. `benchmarks.adaptation` has wear and slow faults.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from ingest import read_log
from ingest.log import Log
from ingest.simulators.airpath import simulate_airpath
from ingest.simulators.faults import Fault
from pipeline.comparing import Comparison, compare_detectors
from pipeline.detector import Detector
from pipeline.diagnosing import diagnose
from pipeline.fitting import fit, learn, sections, suspicious
from pipeline.recipe import Recipe, build_recipe, load_recipe
from pipeline.retraining import challenge, continue_champion
from pipeline.template import bound, common_signals
from stages.stage import Stage, transform

Sections = tuple[Sequence[Stage], Sequence[Stage], Sequence[Stage]]
SEED = 60000
SETS = 8  # of training drives, for `domain`
CYCLES = ("wltc_3b", "udds", "ftp75", "us06", "hwfet")
FAULTS = (
    ("maf_gain", 0.05), ("maf_gain", -0.05), ("boost_pressure_gain", 0.02), ("intake_pressure_gain", 0.02),
    ("boost_leak", 6.0), ("intake_leak", 6.0),
)  # fmt: skip


def drive(
    cycle: str, seed: int, fault: tuple[str, float] | None = None, onset: float | None = None, **more: object
) -> Log:
    faults = [Fault(name=fault[0], magnitude=fault[1], onset_s=onset)] if fault else []
    return simulate_airpath(cycle=cycle, seed=seed, faults=faults, name=f"{cycle}_{seed}", **more)  # type: ignore[arg-type]


def recipe_with(nodes: int, name: str = "diesel_airpath") -> Recipe:
    """An air path with smaller maps."""
    recipe = load_recipe(name)
    definition = recipe.to_json()
    for stage in definition["stage"]:
        for relation in stage.get("relations", {}).values():
            relation["nodes"] = nodes
    return build_recipe(recipe.name, definition)


def domain(seeds: int, first: int) -> None:
    print(f"\n{SETS} times trained on 3 UDDS, calibrated on 3 more, tested on US06")
    recipe = load_recipe("diesel_airpath")
    titles = ("UDDS alone", "two US06 added", "the same, warm")
    alarms, inside = {t: [0] * SETS for t in titles}, {t: [0.0] * SETS for t in titles}
    found = {(t, fault): [0, 0] for t in titles for fault in FAULTS}
    for s in range(SETS):
        base = first + 10_000 + 500 * s
        training = [drive("udds", base + i) for i in range(3)]
        calibrate = [drive("udds", base + 10 + i) for i in range(3)]
        added = [drive("us06", base + 20 + i) for i in range(2)]
        before = fit(training, recipe, calibrate)
        after = challenge([*training, *added], recipe, before, calibrate)
        healthy = [drive("us06", base + 100 + i) for i in range(4 * seeds)]
        faulty = [(f, drive("us06", base + 200 + i, f)) for f in FAULTS for i in range(seeds)]
        for title, detector in zip(titles, (before, after, continue_champion(before, added)), strict=True):
            said = [diagnose(log, detector) for log in healthy]
            alarms[title][s] = sum(d.verdict.fault not in ("none", "insufficient_evidence") for d in said)
            inside[title][s] = float(np.mean([d.samples["in_domain"].mean() for d in said]))  # type: ignore[arg-type]
            for fault, log in faulty:
                verdict = diagnose(log, detector).verdict
                found[title, fault][0] += verdict.detected_s is not None
                found[title, fault][1] += verdict.fault == fault[0]
    for title in titles:
        by_set = ", ".join(map(str, alarms[title]))
        print(f"  {title}: healthy drives with an alarm {sum(alarms[title])}/{4 * seeds * SETS} "
              f"(by training set {by_set}), {100 * np.mean(inside[title]):.0f} % in domain")  # fmt: skip
        for fault in FAULTS:
            seen, right = found[title, fault]
            n = seeds * SETS
            print(f"    {fault[0]:22s}{fault[1]:+6g}  detected {seen}/{n}, named {right}/{n}")


def poison(seeds: int, first: int) -> None:
    print("\nsets of 20 drives, sensors with tolerances per drive (level 2)")
    counts = {"sets": 0, "caught": 0, "exact": 0, "clean named": 0, "clean": 0}
    recipe = load_recipe("diesel_airpath")
    flagged = 0
    logs_found: dict[str, list[int]] = {name: [0, 0] for name, _ in FAULTS}
    for s in range(seeds):
        base = first + 1000 + 20 * s
        logs = [drive(CYCLES[i % 5], base + i, tolerance=2) for i in range(20)]
        sides = sections(bound(recipe, common_signals(logs)).stages)
        healthy = [transform(sides[0], log) for log in logs]
        flagged += bool(guarded(sides, healthy))
        rng = np.random.default_rng(base)
        for fault in FAULTS:
            here = dict.fromkeys(counts, 0)
            for share in (2, 6):
                which = {int(i) for i in rng.choice(20, share, replace=False)}
                blocks = [*healthy]
                for i in which:
                    log = drive(CYCLES[i % 5], base + i, fault, 0.0, tolerance=2)
                    blocks[i] = transform(sides[0], log)
                found = guarded(sides, blocks)
                here["sets"] += 1
                logs_found[fault[0]][0] += len(found & which)
                logs_found[fault[0]][1] += share
                here["caught"] += bool(found & which)
                here["exact"] += found == which
                here["clean named"] += len(found - which)
                here["clean"] += 20 - share
            print(f"  set {s}, {fault[0]} {fault[1]:+g}: exact {here['exact']}/{here['sets']}", flush=True)
            counts = {k: counts[k] + here[k] for k in counts}
    n = counts["sets"]
    print(f"  caught {counts['caught']}/{n}, exact set named {counts['exact']}/{n}, clean logs named "
          f"{counts['clean named']}/{counts['clean']}, clean sets flagged {flagged}/{seeds}")  # fmt: skip
    print("  faulty logs found:", ", ".join(f"{k} {a}/{b}" for k, (a, b) in logs_found.items()))


def guarded(sides: Sections, blocks: Sequence[Log]) -> set[int]:
    """The places of the prepared logs that the guard of a fit finds suspicious."""
    prepare, models, decide = sides
    fitted = learn(models, [(prepare, block) for block in blocks])
    try:
        found = suspicious([*prepare, *fitted], decide, blocks, len(prepare))
    except ValueError:  # more than 40 %
        return set(range(len(blocks)))
    return {i for i, f in enumerate(found) if f}


def comparison(seeds: int, first: int) -> None:
    print("\nchampion and challengers on the same held-out drives")
    recipe = load_recipe("diesel_airpath")
    judged = {"better": 0, "worse": 0, "rows": 0}
    for s in range(seeds):
        base = first + 5000 + 100 * s
        calibrate = [drive(CYCLES[i % 5], base + i) for i in range(5)]
        held_out = [drive(CYCLES[i % 5], base + 10 + i, duration_s=600) for i in range(6)]
        training = [drive(c, base + 20 + i) for i, c in enumerate(CYCLES[:3])]
        others = [drive(c, base + 30 + i) for i, c in enumerate(CYCLES[:3])]
        champion = fit(training, recipe, calibrate)
        found = compare_detectors(champion, fit(others, recipe, calibrate), held_out)
        rows = [r.interval.verdict for r in found.rows if r.interval]
        judged = {k: judged[k] + sum(v == k for v in rows) for k in ("better", "worse")} | {
            "rows": judged["rows"] + len(rows)
        }
        said(f"set {s}, trained on other drives", found)
        if s > 0:
            continue
        for nodes in (4, 3, 2, 1):
            challenger = fit(training, recipe_with(nodes), calibrate)
            said(f"set {s}, {nodes} region(s)", compare_detectors(champion, challenger, held_out))
        bad = [drive(CYCLES[0], base + 30, ("maf_gain", 0.05), 0.0), *others[1:]]
        challenger = fit(bad, recipe, calibrate, trust=True)
        title = f"set {s}, a third of the drives with maf +5 %, guard off"
        said(title, compare_detectors(champion, challenger, held_out))
    print(
        f"  rows of equal detectors: better {judged['better']}, worse {judged['worse']} of {judged['rows']}"
    )


def said(title: str, found: Comparison) -> None:
    worse = [f"{r.what} {r.of}".strip() for r in found.rows if r.interval and r.interval.verdict == "worse"]
    print(f"  {title}: {found.verdict}; worse rows {len(worse)}: {', '.join(worse[:4])}")
    for what, i in ((r.what, r.interval) for r in found.rows if r.pooled):
        if i:
            bounds = f"{i.low:.3g} to {i.high:.3g}"
            print(f"    {what:20s}{i.champion:8.3g}{i.challenger:8.3g}  {bounds}: {i.verdict}", flush=True)


def speed(hours: float) -> None:
    recipe = load_recipe("diesel_airpath")
    distinct = [drive("wltc_3b", SEED + 8000 + i) for i in range(5)]
    count = max(2, round(2 * hours))
    logs = [replace(distinct[i % 5], name=f"log{i}") for i in range(count)]
    more = [
        replace(distinct[i % 5], name=f"new{i}", facts={"sha256": f"new{i}"})
        for i in range(max(1, count // 10))
    ]
    calibrate = [drive("udds", SEED + 8100, duration_s=400)]
    fit(logs[:1], recipe, calibrate)  # compiles
    champion, first = timed(lambda: fit(logs, recipe, calibrate))
    _, whole = timed(lambda: fit([*logs, *more], recipe, calibrate))
    _, warm = timed(lambda: continue_champion(champion, more))
    print(f"\n{count / 2:.0f} h at 50 Hz fitted in {first:.1f} CPU s (logs in memory)")
    print(f"{len(more) / 2:g} h more: from scratch {whole:.1f} CPU s, warm {warm:.1f} CPU s, "
          f"{whole / warm:.1f} times as fast")  # fmt: skip


def timed(work):  # type: ignore[no-untyped-def]
    began = time.process_time()
    result = work()
    return result, time.process_time() - began


def bench(folder: Path) -> None:
    mapping = Path("data/maps/liu_ice.toml")
    logs = {p.stem.removeprefix("wltp_"): read_log(p, mapping) for p in sorted(folder.glob("wltp_*.csv"))}
    healthy, recipe = logs.pop("NF"), load_recipe("si_airpath")
    start, end = healthy.span
    parts = np.linspace(start, end, 5)
    last = np.linspace(parts[3], end, 4)
    first = healthy.between(start, parts[2])
    champion = fit([first], recipe)
    second = healthy.between(parts[2], parts[3])
    held_out = [replace(healthy.between(a, b), name=f"NF_{a:.0f}") for a, b in pairwise(last)]
    scratch = challenge([first, second], recipe, champion)
    warm = continue_champion(champion, [replace(second, facts={"sha256": "second"})])
    print("\nLiU-ICE: fitted on the first half of the fault-free log, retrained with its third quarter")
    for title, challenger in (("from scratch", scratch), ("warm", warm)):
        found = compare_detectors(champion, challenger, held_out)
        said(title, found)
        for name, log in logs.items():
            was, now = (evidence(d, log) for d in (champion, challenger))
            print(
                f"    {name:12s} largest evidence {was:10.0f} -> {now:10.0f} ({100 * (now / was - 1):+.0f} %)"
            )

    half = np.linspace(parts[2], end, 7)
    held_out = [replace(healthy.between(a, b), name=f"NF_{a:.0f}") for a, b in pairwise(half)]
    few = fit([first], recipe_with(4, recipe.name))
    said("4 regions instead of 16, on the second half", compare_detectors(champion, few, held_out))


def evidence(detector: Detector, log: Log) -> float:
    """The largest that any fault reaches."""
    samples = diagnose(log, detector).samples
    return max(float(np.nanmax(samples[c].to_numpy())) for c in samples.columns if c.startswith("evidence."))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART")
    parser.add_argument(
        "--seeds", type=int, default=10, help="drives of a kind, and a twentieth as many sets"
    )
    parser.add_argument("--first", type=int, default=SEED, help="seed that those of the drives count from")
    parser.add_argument("--hours", type=float, default=100.0)
    parser.add_argument("--folder", type=Path)
    args = parser.parse_args()
    sets = max(1, args.seeds // 20)
    work = {
        "domain": lambda: domain(args.seeds, args.first), "poison": lambda: poison(sets, args.first),
        "comparison": lambda: comparison(sets, args.first), "speed": lambda: speed(args.hours),
    }  # fmt: skip
    if args.folder:
        work["bench"] = lambda: bench(args.folder)
    if unknown := {*args.parts} - {*work}:
        parser.error(f"no part {', '.join(sorted(unknown))}; `bench` needs --folder")
    for part in args.parts or work:
        work[part]()


if __name__ == "__main__":
    main()
