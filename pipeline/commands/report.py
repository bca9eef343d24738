"""``dynoscope report``: a batch as one static page."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "one self-contained HTML page over a batch: verdicts, plots, confusion where the truth is known"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("out", type=Path, metavar="OUT", help="the folder of a batch, or of one run in it")
    parser.add_argument(
        "--drawn", type=int, default=40, metavar="N",
        help="logs with plots of their own, those with a fault first; default 40",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    from ingest.errors import DynoscopeError
    from pipeline.console import talk
    from pipeline.reporting import write_report

    if args.drawn < 0:
        raise DynoscopeError(f"--drawn {args.drawn}: expected 0 or more")
    path = write_report(args.out, args.drawn, talk)
    print(path)
    return 0
