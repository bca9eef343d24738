"""``dynoscope ingest``: any supported log as MCAP and Parquet, in canonical names and units."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ingest.maps import NameMap

HELP = (
    "read logs of any supported format, name and convert their channels, write MCAP and Parquet and a report"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("logs", nargs="+", metavar="LOG", help="files, folders, globs, @list.txt")
    parser.add_argument("--out", required=True, type=Path, metavar="DIR", help="where the results go")
    parser.add_argument("--map", type=Path, help="TOML file that names and converts the logs' channels")
    parser.add_argument("--json", action="store_true", help="print what was written as JSON")


def run(args: argparse.Namespace) -> int:
    from ingest.errors import DynoscopeError, LogError
    from ingest.files import find_logs, unique_stems
    from ingest.maps import NameMap, load_map
    from pipeline.console import print_json, print_table, progress

    names = load_map(args.map) if args.map else NameMap()
    paths = find_logs(args.logs)
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LogError(f"output folder {args.out} cannot be made: {error.strerror or error}") from error
    rows = []
    with progress("ingesting", len(paths)) as step:
        for stem, path in zip(unique_stems(paths), paths, strict=True):
            try:
                rows.append({"log": stem, **_ingest(path, stem, args.out, names)})
            except (DynoscopeError, OSError, MemoryError) as error:
                rows.append({"log": stem, "status": "failed", "reason": str(error) or type(error).__name__})
            step(f"{stem}: {rows[-1]['status']}")
    if args.json:
        print_json(rows)
    else:
        columns = ("log", "status", "seconds", "rows", "signals", "notes", "reason")
        print_table(rows, {c: c for c in columns if any(row.get(c) is not None for row in rows)})
    return 1 if any(row["status"] == "failed" for row in rows) else 0


def _ingest(path: Path, stem: str, out: Path, names: NameMap) -> dict[str, Any]:
    """Writes ``out/<stem>.mcap``, ``out/<stem>/<group>.parquet`` and ``out/<stem>/report.json``."""
    import json
    from dataclasses import replace

    from ingest import read_log, write_log
    from ingest.files import group_file
    from ingest.report import describe
    from pipeline.files import write_aside

    log = read_log(path, names)
    report = describe(log)
    written = [write_log(log, out / f"{stem}.mcap")]
    for name, group in log.groups.items():
        written.append(write_log(replace(log, groups={name: group}), out / stem / group_file(name)))
    write_aside(out / stem / "report.json", json.dumps(report, indent=1, ensure_ascii=False).encode())
    start, end = log.span
    return {
        "status": "salvaged" if report["salvaged"] else "ok",
        "reason": "; ".join(report["salvaged"]) or None,
        "seconds": end - start,
        "rows": sum(g.frame.height for g in log.groups.values()),
        "signals": len(log.signals),
        "notes": "; ".join(report["notes"]) or None,
        "files": [str(p) for p in (*written, out / stem / "report.json")],
    }
