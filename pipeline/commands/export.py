"""``dynoscope export``: annotated signals for other tools."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "a run's annotated signals as MDF4, CSV or Parquet, for other tools"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("runs", nargs="+", type=Path, metavar="OUT/LOG", help="folders of runs")
    parser.add_argument(
        "--to", nargs="+", required=True, choices=("mf4", "csv", "parquet"), help="one or more formats"
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR",
        help="where the files go, as <log>.<format>; default: each run's folder",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    from ingest.errors import LogError
    from pipeline.console import talk
    from pipeline.exporting import export_run
    from pipeline.runs import run_folders

    folders = [run for given in args.runs for run in (list(run_folders(given)) or [given])]
    failed = False
    for folder in folders:
        for to in args.to:
            path = args.out / f"{folder.resolve().name}.{to}" if args.out else None
            try:
                print(export_run(folder, to, path))
            except LogError as error:
                talk(f"dynoscope export: {error}")
                failed = True
    return 1 if failed else 0
