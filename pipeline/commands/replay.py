"""``dynoscope replay``: a log as it happened, live in the viewer."""

from __future__ import annotations

import argparse

from pipeline.commands.run import add_detector_arguments, chosen

HELP = "replay a log causally through the stages into a live Rerun viewer"
SPEED = 20.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", metavar="LOG", help="a log")
    add_detector_arguments(parser)
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
    from pipeline.showing import replay_log
    from viz.summary import headline, magnitude_text

    problems = Problems()
    with problems:
        if args.speed is not None and not args.speed > 0.0:
            raise DynoscopeError(f"--speed {args.speed:g}: expected more than 0")
    names, detector = chosen(args, problems)
    with problems:
        paths = find_logs([args.log])
        if len(paths) != 1:
            raise LogError(f"{args.log} is {len(paths)} logs; replay takes one")
    problems.raise_any()
    assert detector is not None
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
