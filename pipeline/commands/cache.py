"""``dynoscope cache``: what the cache holds, and making room in it."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

HELP = "the cache of read logs and finished runs: info, prune"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    info = actions.add_parser("info", help="how much it holds")
    prune = actions.add_parser("prune", help="remove what was not used for longest, all by default")
    for action in (info, prune):
        action.add_argument("--cache", type=Path, metavar="DIR", help="default: ~/.cache/dynoscope")
        action.add_argument("--json", action="store_true", help="print the result as JSON")
    prune.add_argument("--keep-gb", type=float, metavar="X", help="until at most X GB remain")
    prune.add_argument("--older-than", type=float, metavar="DAYS", help="what was not used for DAYS")


def run(args: argparse.Namespace) -> int:
    from ingest.errors import StoreError
    from pipeline.cache import Cache, default_folder

    folder = args.cache or default_folder()
    if args.cache and not args.cache.is_dir():
        raise StoreError(f"cache {args.cache}: there is no such folder")
    cache = Cache(folder)
    if args.action == "info":
        _print({"cache": str(folder), **_amounts(cache)}, as_json=args.json)
        return 0
    gone = cache.prune(
        keep_bytes=None if args.keep_gb is None else int(args.keep_gb * 1e9),
        older_than_s=None if args.older_than is None else args.older_than * 86400.0,
    )
    removed = {"removed": len(gone), "removed_bytes": sum(e.bytes for e in gone)}
    _print({"cache": str(folder), **removed, **_amounts(cache)}, as_json=args.json)
    return 0


def _amounts(cache: Any) -> dict[str, Any]:
    """Counts and bytes by kind, and when the least recently used entry was used."""
    from datetime import UTC, datetime

    from pipeline.cache import LOGS, RUNS

    entries = cache.entries()
    found: dict[str, Any] = {}
    for kind in (LOGS, RUNS):
        sizes = [e.bytes for e in entries if e.path.parent.name == kind]
        found |= {kind: len(sizes), f"{kind}_bytes": sum(sizes)}
    oldest = datetime.fromtimestamp(entries[0].used, UTC).isoformat(timespec="seconds") if entries else None
    return found | {"least_recently_used": oldest}


def _print(values: dict[str, Any], *, as_json: bool) -> None:
    from pipeline.console import print_json

    if as_json:
        print_json(values)
        return
    for name, value in values.items():
        text = f"{value / 1e6:.1f} MB" if name.endswith("bytes") else value if value is not None else "never"
        print(f"{name.replace('_', ' ')}: {text}")
