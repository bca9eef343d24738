"""``dynoscope retrain``: train a challenger, compare it with the champion, and promote it if it may be."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.commands.ingest import add_map_arguments, names_of

if TYPE_CHECKING:
    from ingest.log import Log

HELP = "train a challenger on fault-free logs and compare it with the champion on the same held-out logs"
ROLES = {
    "logs": "fault-free logs to train on: files, folders, globs, @list.txt",
    "holdout": "fault-free logs to compare on; default: the last 30 %% of each LOG",
    "calibrate": "further fault-free logs that set spreads and thresholds",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("logs", nargs="*", metavar="LOG", help=ROLES["logs"])
    parser.add_argument(
        "--from-run", type=Path, metavar="OUT",
        help="train on the logs of this batch that are fault-free and of good quality; says which",
    )  # fmt: skip
    parser.add_argument("--recipe", required=True, help="a built-in recipe or a path")
    parser.add_argument("--store", required=True, type=Path, metavar="DIR", help="where detectors are kept")
    for role in ("holdout", "calibrate"):
        parser.add_argument(
            f"--{role}", nargs="+", action="extend", default=[], metavar="LOG", help=ROLES[role]
        )
    parser.add_argument("--warm", action="store_true", help="go on from the champion: give new logs only")
    parser.add_argument("--promote", action="store_true", help="make it champion, unless it is worse")
    parser.add_argument("--force", action="store_true", help="promote it even if it is worse")
    parser.add_argument("--reason", default="", metavar="TEXT", help="why; goes into the champion's history")
    parser.add_argument("--details", action="store_true", help="print also the rows of single regimes")
    parser.add_argument(
        "--trust", action="store_true", help="fit on all logs, even those that do not agree with the others"
    )
    add_map_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print the comparison as JSON")


def run(args: argparse.Namespace) -> int:
    from ingest.errors import DynoscopeError, StoreError
    from ingest.files import find_logs
    from pipeline.console import Problems, print_json, progress, talk
    from pipeline.detector import check_recipe
    from pipeline.recipe import load_recipe
    from pipeline.retraining import because, challenge, compared, continue_champion, promote, split
    from pipeline.store import Store

    problems = Problems()
    with problems:
        if args.force and not (args.promote and args.reason):
            raise DynoscopeError("--force goes with --promote and a --reason")
    with problems:
        recipe = load_recipe(args.recipe)
    with problems:
        names = names_of(args)
    if not problems.errors:
        with problems:
            store = Store(args.store)
            champion = store.get(recipe.name)
            if recipe.template:  # the champion says which signals
                recipe = champion.recipe
    paths: dict[str, list[Path]] = {}
    for role in ROLES:
        with problems:
            paths[role] = find_logs(getattr(args, role)) if getattr(args, role) else []
    with problems:
        paths["logs"] = _proposed(args, paths.get("logs", []))
    problems.raise_any()
    logs = read_all(paths, names, problems)
    training, held_out = (logs["logs"], logs["holdout"]) if logs["holdout"] else split(logs["logs"])
    if args.warm:
        check_recipe(champion, recipe)
        challenger = continue_champion(champion, training, logs["calibrate"], talk, trust=args.trust)
    else:
        challenger = challenge(training, recipe, champion, logs["calibrate"], talk, trust=args.trust)
    store.keep(challenger)
    for note in challenger.record["notes"]:
        talk(f"note: {note}")
    talk(f"challenger {challenger.key} kept in {store.folder}")
    with progress("comparing", len(held_out)) as step:
        found = compared(store, champion, challenger, held_out, step)
    if args.json:
        print_json(found)
    else:
        print_comparison(found, details=args.details)
    if args.promote:
        try:
            promote(store, challenger, args.reason, force=args.force)
        except StoreError as error:
            talk(f"not promoted: {error}")
            return 1
        talk(f"{challenger.key} is champion of {recipe.name} now")
    elif not args.json:
        talk(f"the champion is still {champion.key} ({because(found)})")
    return 0


def _proposed(args: argparse.Namespace, given: list[Path]) -> list[Path]:
    """The logs to train on: those given, and those that a batch proposes.

    Raises:
        LogError: there are none.
    """
    from ingest.errors import LogError
    from pipeline.console import talk
    from pipeline.proposing import propose

    proposals = propose(args.from_run) if args.from_run else []
    for p in proposals:
        talk(f"{'take' if p.proposed else 'leave'} {p.log}: {p.why}")
    found = [*given, *(Path(p.path) for p in proposals if p.proposed)]
    if not found and not args.logs:
        raise LogError(
            f"no log of {args.from_run} is fit to train on" if args.from_run
            else "no LOG to train on; name fault-free logs, or a batch with --from-run"
        )  # fmt: skip
    return found


def read_all(paths: Mapping[str, list[Path]], names: Any, problems: Any) -> dict[str, list[Log]]:
    """The logs by role; every one that cannot be read is listed."""
    from ingest import read_log

    logs: dict[str, list[Log]] = {role: [] for role in paths}
    for role, files in paths.items():
        for path in files:
            with problems:
                logs[role].append(read_log(path, names))
    problems.raise_any()
    return logs


def print_comparison(found: Mapping[str, Any], *, details: bool = False) -> None:
    """The table on stdout; rows that decide are marked, those of single regimes left out without
    ``details``."""
    from pipeline.console import print_table
    from pipeline.retraining import because

    def interval(row: Mapping[str, Any]) -> str | None:
        if row["verdict"] is None:
            return None
        low, high = ("?" if row[k] is None else f"{row[k]:.3g}" for k in ("low", "high"))
        return f"{low} … {high}"

    rows = [
        {**row, "interval": interval(row), "decides": "*" if row["pooled"] else None}
        for row in found["rows"]
        if details or " in regime " not in row["of"]
    ]
    headings = ("what", "of", "unit", "champion", "challenger", "difference", "interval", "drives", "verdict")
    print_table(rows, {h: h for h in headings} | {"decides": "decides"})
    print(f"\non {len(found['logs'])} held-out log(s), {found['hours']:.2f} h: the challenger is "
          f"{found['verdict']} ({because(found)})")  # fmt: skip
