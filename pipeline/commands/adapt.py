"""``dynoscope adapt``: follow a vehicle's wear over its logs, and tell faults from it."""

from __future__ import annotations

import argparse
from pathlib import Path

from pipeline.commands.ingest import add_map_arguments, names_of

HELP = "follow the wear of one vehicle over its logs in order, and tell slow faults from it"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("logs", nargs="+", metavar="LOG", help="the vehicle's logs, oldest first")
    parser.add_argument("--recipe", required=True, help="a built-in recipe or a path")
    parser.add_argument("--store", required=True, type=Path, metavar="DIR", help="where detectors are kept")
    parser.add_argument("--detector", default="champion", metavar="KEY", help="default: the champion")
    parser.add_argument(
        "--commissioning", type=int, default=10, metavar="N",
        help="so many of the first logs are the reference; a fault in them is invisible (default 10)",
    )  # fmt: skip
    parser.add_argument(
        "--out", type=Path, metavar="OUT",
        help="the folder of a batch: leaves wear.json there, which `report OUT` and `view OUT` draw",
    )  # fmt: skip
    add_map_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run(args: argparse.Namespace) -> int:
    from ingest.files import find_logs
    from pipeline.adapting import adapt
    from pipeline.commands.retrain import read_all
    from pipeline.console import Problems, print_json, print_table, progress, talk
    from pipeline.recipe import load_recipe
    from pipeline.store import Store
    from pipeline.wear import check_batch, denied, faults_of, keep_wear, state_of

    problems = Problems()
    with problems:
        names = names_of(args)
        recipe = load_recipe(args.recipe)
        detector = Store(args.store).get(recipe.name, args.detector)
    with problems:
        paths = find_logs(args.logs)
    with problems:
        if args.out is not None:
            check_batch(args.out)
    problems.raise_any()
    logs = read_all({"logs": paths}, names, problems)["logs"]
    with progress("following", len(logs)) as step:
        report = adapt(logs, detector, args.commissioning, progress=step)
    if args.out is not None:
        talk(f"wrote {keep_wear(args.out, report)}")
    if args.json:
        print_json(report)
        return 0
    rows = []
    for d in report["drives"]:
        wear = {n: f"{w['value']:.3g} +- {w['sd']:.1g}" for n, w in d["wear"].items()}
        state = {"learned from": None}.get(state_of(d), state_of(d))
        rows.append({"log": d["log"], "evidence": d["T"], "": state, "faults": faults_of(d), **wear})
    print_table(rows, {k: k for k in rows[0]})
    if (z := denied(report["drives"][-1])) is not None:
        print(f"this wear does not show where it must ({z:.1f} standard deviations): "
              "a fault that looks like it is likelier")  # fmt: skip
    for name, b in report["budgets"].items():
        unit = "" if b["unit"] == "1" else f" {b['unit']}"
        print(f"budget of {name}: {b['per_100_drives']:g}{unit} in 100 drives, {b['total']:g}{unit} in all; "
              "more is told as a fault")  # fmt: skip
    return 0
