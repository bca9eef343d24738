"""``dynoscope select``: which lags of which signals each output depends on."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ingest.log import Log
    from stages.selecting import Selection

HELP = "input selection: orders and delays of the signals that each output depends on"
SEARCHES = ("evidence", "exhaustive", "genetic", "coordinate")
CRITERIA = ("evidence", "pooled", "printed", "scaled", "bic", "aic")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("logs", nargs="+", metavar="LOG", help="files, folders, globs, @list.txt")
    parser.add_argument("--recipe", required=True, help="a built-in recipe or a path")
    parser.add_argument("--output", nargs="+", action="extend", default=[], metavar="NAME", help="outputs")
    parser.add_argument("--input", nargs="+", action="extend", default=[], metavar="NAME", help="candidates")
    for name, text in (
        ("na", "order of the outputs' past"),
        ("nb", "number of regressors of an input"),
        ("nk", "delay of an input in samples, 0 is its present value"),
    ):
        parser.add_argument(
            f"--{name}-max", type=int, metavar="N", help=f"largest {text}; default: the recipe's"
        )
    parser.add_argument(
        "--search", choices=SEARCHES,
        help="default: the rule `evidence`; the others minimise a criterion on one partition",
    )  # fmt: skip
    parser.add_argument("--criterion", choices=CRITERIA, help="default of a partition: pooled")
    parser.add_argument("--auto", action="store_true", help="let bounds grow until the optimum lies inside")
    parser.add_argument(
        "--seed", type=int, metavar="N", help="of the rows drawn and of the searches; default 0"
    )
    parser.add_argument("--map", type=Path, help="TOML file that names and converts the logs' channels")
    parser.add_argument(
        "--out", type=Path, metavar="DIR",
        help="also write selection.json, selection.rrd and <output>.svg there: correlations, the best genes, "
        "the search's course, and what a model of the best one leaves",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print everything as JSON")


def run(args: argparse.Namespace) -> int:
    from ingest import read_log
    from ingest.errors import LogError
    from ingest.files import find_logs
    from ingest.maps import load_map
    from pipeline.console import Problems, print_json, talk
    from pipeline.recipe import load_recipe
    from pipeline.selecting import Request, select_inputs, to_json, write_answers

    problems = Problems()
    with problems:
        recipe = load_recipe(args.recipe)
    with problems:
        names = load_map(args.map) if args.map else None
    with problems:
        if args.out is not None and args.out.exists() and not args.out.is_dir():
            raise LogError(f"{args.out} is not a folder; --out takes one, or one that is to be made")
    with problems:
        paths = find_logs(args.logs)
    problems.raise_any()
    logs: list[Log] = []
    for path in paths:
        with problems:
            logs.append(read_log(path, names))
    problems.raise_any()
    search = {k: v for k in ("search", "criterion", "seed") if (v := getattr(args, k)) is not None}
    request = Request(
        outputs=args.output, inputs=args.input, search=search | ({"auto": True} if args.auto else {}),
        bounds={f"{k}_max": getattr(args, f"{k}_max") for k in ("na", "nb", "nk")},
        portraits=args.out is not None,
    )  # fmt: skip
    selected = select_inputs(logs, recipe, request, progress=talk)
    if args.out is not None:
        write_answers(selected, args.out)
        talk(f"pictures in {args.out}")
    if args.json:
        print_json({output: to_json(*answer[:2]) for output, answer in selected.items()})
    else:
        for output, (selection, seconds, _) in selected.items():
            _print(output, selection, seconds)
    return 0


def _print(output: str, selection: Selection, seconds: float) -> None:
    from pipeline.console import print_table

    found, s = selection.found, selection.structure
    proven = "proven optimum" if found.optimal else "best found"
    print(
        f"{output}: {proven} of {selection.space.size} genes by {selection.criterion} {found.score:.6g}, "
        f"{found.evaluated} evaluated, {selection.rows} rows, {selection.regions} regions, {seconds:.3f} s"
    )
    rows: list[dict[str, Any]] = [{"signal": n, "na": k} for n, k in s.na.items()]
    rows += [{"signal": n, "nb": s.nb[n], "nk": s.nk[n]} for n in s.nb]
    for row in rows:
        row["regressors"] = " ".join(f"t-{k}" if k else "t" for n, k in s.regressors if n == row["signal"])
    print_table(rows, {"signal": "signal", "na": "na", "nb": "nb", "nk": "nk", "regressors": "regressors"})
    print()
