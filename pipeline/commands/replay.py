"""``dynoscope replay``: a log as it happened, live in the viewer."""

from __future__ import annotations

import argparse
from pathlib import Path

from pipeline.commands.ingest import add_map_arguments, names_of

HELP = "replay a log causally through the stages into a live Rerun viewer"
SPEED = 20.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", metavar="LOG", help="a log")
    parser.add_argument("--recipe", required=True, help="a built-in recipe or a path")
    parser.add_argument(
        "--store", type=Path, metavar="DIR",
        help="where detectors are kept; not needed by a recipe that can do without learning",
    )  # fmt: skip
    parser.add_argument("--detector", default="champion", metavar="KEY", help="default: the champion")
    add_map_arguments(parser)
    parser.add_argument(
        "--speed", type=float, metavar="X",
        help=f"times real time; default {SPEED:g}, without a viewer as fast as it goes",
    )  # fmt: skip
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--no-viewer", action="store_true", help="only say what happens")
    where.add_argument("--web", action="store_true", help="serve the viewer to a browser on this machine")
    parser.add_argument("--json", action="store_true", help="print the verdict as JSON")


def run(args: argparse.Namespace) -> int:
    from ingest.errors import DynoscopeError, LogError
    from ingest.files import find_logs, read_log
    from pipeline.console import Problems, print_json, talk
    from pipeline.detector import check_recipe, unfitted_detector
    from pipeline.recipe import load_recipe
    from pipeline.showing import replay_log
    from pipeline.store import Store
    from viz.summary import headline, magnitude_text

    problems = Problems()
    with problems:
        if args.speed is not None and not args.speed > 0.0:
            raise DynoscopeError(f"--speed {args.speed:g}: expected more than 0")
    with problems:
        recipe = load_recipe(args.recipe)
    recipe_is_right = not problems.errors
    with problems:
        names = names_of(args)
    with problems:
        store = Store(args.store) if args.store else None
        if recipe_is_right:
            detector = store.get(recipe.name, args.detector) if store else unfitted_detector(recipe)
            check_recipe(detector, recipe)
    with problems:
        paths = find_logs([args.log])
        if len(paths) != 1:
            raise LogError(f"{args.log} is {len(paths)} logs; replay takes one")
    problems.raise_any()
    speed = args.speed or (None if args.no_viewer else SPEED)
    log = read_log(paths[0], names)
    verdict = replay_log(log, detector, speed, viewer=not args.no_viewer, web=args.web, tell=talk).verdict
    if args.json:
        print_json(verdict.to_json())
        return 0
    size = f", {magnitude_text(verdict.magnitude)}" if verdict.magnitude else ""
    since = "" if verdict.onset_s is None else f", since {verdict.onset_s:.1f} s"
    seen = "" if verdict.detected_s is None else f", detected at {verdict.detected_s:.1f} s"
    print(f"{log.name}: {headline(verdict)}{size}{since}{seen}")
    return 0
