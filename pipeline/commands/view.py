"""``dynoscope view``: open runs, recordings and logs in Rerun."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ingest.log import Log

HELP = "open a run, a log or several in Rerun"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "paths",
        nargs="+",
        metavar="PATH",
        help="a run's folder, a folder of runs, an .rrd recording, or a log",
    )
    parser.add_argument("--map", type=Path, help="TOML file that names and converts the channels of logs")
    parser.add_argument("--web", action="store_true", help="serve to a browser on this machine")
    parser.add_argument("--save", type=Path, metavar="FILE.rrd", help="write one recording, open nothing")


def run(args: argparse.Namespace) -> int:
    from viz import show

    show(*sources(args.paths, args.map), web=args.web, save=args.save)
    if args.save is not None:
        print(f"wrote {args.save}", file=sys.stderr)
    return 0


def sources(paths: list[str], names: Path | None = None) -> list[Path | Log]:
    """Recordings and runs as they are, everything else read as logs.

    Raises:
        LogError: a path is neither.
    """
    from ingest.files import find_logs, read_log
    from viz.viewer import is_recording, is_run

    found: list[Path | Log] = []
    for text in paths:
        path = Path(text)
        if is_recording(path) or is_run(path):
            found.append(path)
        else:
            found += [read_log(log, names) for log in find_logs([text])]
    return found
