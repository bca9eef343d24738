"""``dynoscope replay-check``: do stored logs still give what they gave?"""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "replay stored sets of logs and tell every difference from their stored outputs"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "sets", nargs="*", type=Path, metavar="SET",
        help="folders with a set.toml; default: those in data/replay of the checkout",
    )  # fmt: skip
    parser.add_argument(
        "--update", action="store_true", help="store what they give now as what is expected; look at the diff"
    )
    parser.add_argument("--json", action="store_true", help="print the differences as JSON")


def run(args: argparse.Namespace) -> int:
    from dataclasses import asdict

    from ingest.errors import LogError
    from pipeline.console import print_json, talk
    from pipeline.regression import SET, check, update

    home = Path(__file__).resolve().parents[2] / "data" / "replay"
    sets = args.sets or sorted(p.parent for p in home.glob(f"*/{SET}"))
    if not sets:
        raise LogError(f"no sets to replay in {home}; name a folder with a {SET}")
    if args.update:
        for folder in sets:
            talk(f"{folder.name}: stored what is expected of {', '.join(update(folder))}")
        return 0
    found = []
    for folder in sets:
        differences = check(folder)
        talk(f"{folder.name}: {len(differences) or 'no'} difference(s)")
        found += differences
    if args.json:
        print_json([asdict(d) for d in found])
    else:
        print("\n".join(map(str, found)), end="\n" if found else "")
    return 1 if found else 0
