"""``dynoscope fit``: fit a detector on fault-free logs and keep it in a store."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.commands.ingest import add_map_arguments, names_of

if TYPE_CHECKING:
    from ingest.log import Log

HELP = "fit a recipe's detectors on fault-free logs; prints the detector's key"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "logs", nargs="*", metavar="LOG", help="fault-free logs: files, folders, globs, @list.txt"
    )
    parser.add_argument("--recipe", required=True, help="a built-in recipe or a path")
    parser.add_argument("--store", required=True, type=Path, metavar="DIR", help="where detectors are kept")
    parser.add_argument(
        "--calibrate", nargs="+", action="extend", default=[], metavar="LOG",
        help="further fault-free logs that set spreads and thresholds",
    )  # fmt: skip
    parser.add_argument(
        "--from", dest="source", metavar="KEY",
        help="keep the models of this detector (or champion) and only set spreads and thresholds anew",
    )  # fmt: skip
    parser.add_argument(
        "--false-alarms", type=float, metavar="X", help="with --from: false alarms per hour to allow"
    )
    for name in ("output", "input"):
        parser.add_argument(
            f"--{name}", nargs="+", action="extend", default=[], metavar="NAME",
            help=f"{name}s of a recipe for any signals, such as narx; names or patterns",
        )  # fmt: skip
    parser.add_argument(
        "--trust", action="store_true", help="fit on all logs, even those that do not agree with the others"
    )
    add_map_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print the detector's record")


def run(args: argparse.Namespace) -> int:
    from ingest import read_log
    from ingest.files import find_logs
    from pipeline.calibrating import calibrate
    from pipeline.console import Problems, print_json, talk
    from pipeline.detector import check_recipe
    from pipeline.fitting import fit
    from pipeline.recipe import load_recipe
    from pipeline.store import Store
    from pipeline.template import with_signals

    problems = Problems()
    with problems:
        _check(args)
    with problems:
        recipe = load_recipe(args.recipe)
        if args.output or args.input:
            recipe = with_signals(recipe, args.output, args.input)
    with problems:
        names = names_of(args)
    with problems:
        store = Store(args.store)
    paths: dict[str, list[Path]] = {}
    for role, patterns in (("training", args.logs), ("calibration", args.calibrate)):
        with problems:
            paths[role] = find_logs(patterns) if patterns else []
    if args.source and not problems.errors:
        with problems:
            known = store.get(recipe.name, args.source)
            check_recipe(known, recipe)
    problems.raise_any()
    logs: dict[str, list[Log]] = {role: [] for role in paths}
    for role, files in paths.items():
        for path in files:
            with problems:
                logs[role].append(read_log(path, names))
    problems.raise_any()
    if args.source:
        detector = calibrate(known, logs["calibration"], args.false_alarms, progress=talk)
    else:
        detector = fit(logs["training"], recipe, logs["calibration"], progress=talk, trust=args.trust)
    champion = store.add(detector)
    for note in detector.record["notes"]:
        talk(f"note: {note}")
    talk(f"kept in {store.folder}" + (f" as champion of {recipe.name}" if champion else ""))
    if args.json:
        print_json({**detector.record, "champion": champion})
    else:
        print(detector.key)
    return 0


def _check(args: argparse.Namespace) -> None:
    """What the options mean together.

    Raises:
        DynoscopeError: nothing, or not the same twice.
    """
    from ingest.errors import DynoscopeError

    if args.source and args.logs:
        raise DynoscopeError(
            "--from keeps the models of a detector: give logs with --calibrate, not as LOG; "
            "to train on further logs use `dynoscope retrain`"
        )
    if args.source and not args.calibrate:
        raise DynoscopeError("--from needs fault-free logs to set spreads and thresholds: --calibrate LOG...")
    if not args.source and not args.logs:
        raise DynoscopeError("no LOG to fit on")
    if args.false_alarms is not None and not args.source:
        raise DynoscopeError("--false-alarms goes with --from: fit first, then calibrate")
    if args.false_alarms is not None and not args.false_alarms > 0:
        raise DynoscopeError(f"--false-alarms {args.false_alarms:g}: expected alarms per hour, above 0")
