"""``dynoscope view``: open runs, recordings and logs in Rerun."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

HELP = "open a run, a log or several in Rerun"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "paths",
        nargs="+",
        metavar="PATH",
        help="a run's folder, a batch's, an .rrd recording, or a log; two to four of them side by side",
    )
    parser.add_argument(
        "--layer", type=Path, action="append", default=[], metavar="RUN",
        help="a later run of the same log, shown inside the first one's timeline",
    )  # fmt: skip
    parser.add_argument("--map", type=Path, help="TOML file that names and converts the channels of logs")
    parser.add_argument("--web", action="store_true", help="serve to a browser on this machine")
    parser.add_argument("--save", type=Path, metavar="FILE.rrd", help="write one recording, open nothing")


def run(args: argparse.Namespace) -> int:
    from tempfile import TemporaryDirectory

    from pipeline.viewing import layers, to_show
    from viz import show

    with TemporaryDirectory(prefix="dynoscope-") as folder:
        shown = to_show(args.paths, args.map, Path(folder))
        shown += layers(shown, args.layer, Path(folder))
        show(*shown, web=args.web, save=args.save)
    if args.save is not None:
        print(f"wrote {args.save}", file=sys.stderr)
    return 0
