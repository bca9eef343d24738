"""``dynoscope run``: diagnose logs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.commands.ingest import add_map_arguments, names_of

if TYPE_CHECKING:
    from ingest.maps import NameMap
    from pipeline.console import Problems
    from pipeline.detector import Detector

HELP = "diagnose logs: samples, verdict, annotated log and timeline for each, and a summary"


def add_detector_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--recipe", required=True, help="a built-in recipe or a path")
    parser.add_argument(
        "--store", type=Path, metavar="DIR",
        help="where detectors are kept; not needed by a recipe that can do without learning",
    )  # fmt: skip
    parser.add_argument("--detector", default="champion", metavar="KEY", help="default: the champion")
    add_map_arguments(parser)


def chosen(args: argparse.Namespace, problems: Problems) -> tuple[NameMap | None, Detector | None]:
    """The name map and the detector that a call asks for; what is wrong with them goes to ``problems``."""
    from pipeline.detector import check_recipe, unfitted_detector
    from pipeline.recipe import load_recipe
    from pipeline.store import Store

    recipe, names, detector = None, None, None
    with problems:
        recipe = load_recipe(args.recipe)
    with problems:
        names = names_of(args)
    with problems:
        store = Store(args.store) if args.store else None
        if recipe is not None:
            detector = store.get(recipe.name, args.detector) if store else unfitted_detector(recipe)
            check_recipe(detector, recipe)
    return names, detector


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("logs", nargs="+", metavar="LOG", help="files, folders, globs, @list.txt")
    add_detector_arguments(parser)
    parser.add_argument("--out", required=True, type=Path, metavar="DIR", help="where the results go")
    parser.add_argument("--no-timeline", action="store_true", help="write no Rerun recordings")
    parser.add_argument("--no-report", action="store_true", help="write no report.html over the batch")
    parser.add_argument("--force", action="store_true", help="diagnose again what is done")
    parser.add_argument("--only-failed", action="store_true", help="only logs that failed before")
    parser.add_argument("--dry-run", action="store_true", help="say what would be done, and do nothing")
    parser.add_argument(
        "--cache", type=Path, nargs="?", const=True, metavar="DIR",
        help="keep read logs and finished runs for other calls, default ~/.cache/dynoscope",
    )  # fmt: skip
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--workers", type=int, default=1, metavar="N", help="processes, default 1")
    where.add_argument(
        "--scheduler", metavar="ADDRESS", help="a dask cluster's scheduler instead, such as tcp://host:8786"
    )
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")


def run(args: argparse.Namespace) -> int:
    from ingest.errors import DynoscopeError
    from ingest.files import find_logs, url_of
    from pipeline import batch
    from pipeline.cache import default_folder
    from pipeline.console import Problems, print_json, print_table, progress, talk

    problems = Problems()
    with problems:
        if args.workers < 1:
            raise DynoscopeError(f"--workers {args.workers}: expected 1 or more")
    names, detector = chosen(args, problems)
    with problems:
        paths = find_logs(args.logs, remote=True)
    problems.raise_any()
    assert detector is not None
    options = batch.Options(
        timeline=not args.no_timeline, force=args.force, only_failed=args.only_failed, name_map=names,
        workers=args.workers, scheduler=args.scheduler,
        cache=default_folder() if args.cache is True else args.cache, debug=args.debug,
    )  # fmt: skip
    if args.dry_run:
        intents = [{"log": n, "would": w} for n, w in batch.to_do(paths, detector, args.out, options)]
        if args.json:
            print_json(intents)
        else:
            print_table(intents, {"log": "log", "would": "would"})
        return 0
    with progress("diagnosing", len(paths)) as step:
        summary = batch.run(paths, detector, args.out, options, lambda log, row: step(describe(log, row)))
    drawn = args.no_report or bool(url_of(args.out)) or _reported(args.out)
    talk(f"results in {args.out}")
    rows = summary.to_dicts()
    if args.json:
        print_json(rows)
    else:
        print_summary(rows)
    return 1 if any(row["status"] == "failed" for row in rows) or not drawn else 0


def _reported(out: Path) -> bool:
    """Writes the report; whether that has worked. The runs are done either way."""
    from ingest.errors import LogError
    from pipeline.console import talk
    from pipeline.reporting import write_report

    talk(f"drawing {out / 'report.html'}")
    try:
        write_report(out)
    except LogError as error:
        talk(f"no report: {error}")
        return False
    return True


def describe(log: str, row: dict[str, object]) -> str:
    """One line on one log's row of the summary."""
    return f"{log}: {row['reason']}" if row["status"] == "failed" else f"{log}: {row['fault']}"


def print_summary(rows: list[dict[str, object]]) -> None:
    """The verdict table, with the columns that say anything."""
    from pipeline.console import print_table

    columns = {
        "log": "log", "status": "status", "fault": "fault", "signal": "signal", "p": "p",
        "onset_s": "onset s", "detected_s": "detected s", "magnitude": "magnitude", "unit": "unit",
        "truth": "truth", "reason": "reason",
    }  # fmt: skip
    print_table(rows, {k: v for k, v in columns.items() if any(row[k] is not None for row in rows)})
