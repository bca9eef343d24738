"""``dynoscope ingest``: any supported log as MCAP and Parquet, in canonical names and units."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ingest.maps import NameMap

HELP = (
    "read logs of any supported format, name and convert their channels, write MCAP and Parquet and a report"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("logs", nargs="+", metavar="LOG", help="files, folders, globs, URLs, @list.txt")
    parser.add_argument("--out", required=True, type=Path, metavar="DIR", help="where the results go")
    add_map_arguments(parser)
    parser.add_argument(
        "--join", action="store_true", help="the LOGs continue one another: make one log of them"
    )
    parser.add_argument("--json", action="store_true", help="print what was written as JSON")


def add_map_arguments(parser: argparse.ArgumentParser) -> None:
    """What helps to read a log that does not say everything itself."""
    parser.add_argument("--map", type=Path, help="TOML file that names and converts the logs' channels")
    parser.add_argument(
        "--rate", type=float, metavar="HZ", help="rows per second of a table without a time column"
    )
    parser.add_argument(
        "--dbc", type=Path, nargs="+", default=[], metavar="FILE", help="DBC files that decode CAN traces"
    )


def names_of(args: argparse.Namespace) -> NameMap | None:
    """The map that ``args`` give, None without any of them.

    Raises:
        MapError: the map or the rate is wrong.
    """
    from dataclasses import replace

    from ingest.errors import MapError
    from ingest.maps import NameMap, load_map

    if args.rate is not None and not args.rate > 0:
        raise MapError(f"--rate is {args.rate}; expected rows per second, above 0")
    if missing := [str(path) for path in args.dbc if not path.is_file()]:
        raise MapError(f"--dbc {' '.join(missing)}: there is no such file")
    if not (args.map or args.rate or args.dbc):
        return None
    names = load_map(args.map) if args.map else NameMap()
    time = replace(names.time, rate=args.rate or names.time.rate)
    return replace(names, time=time, dbc=(*names.dbc, *args.dbc))


def run(args: argparse.Namespace) -> int:
    from ingest.errors import DynoscopeError, LogError
    from ingest.files import find_logs, unique_stems
    from pipeline.console import print_json, print_table

    names = names_of(args)
    attachments = {"map.toml": args.map.read_bytes()} if args.map else {}
    paths = find_logs(args.logs)
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LogError(f"output folder {args.out} cannot be made: {error.strerror or error}") from error
    stems = unique_stems(paths)
    jobs = [(stems[0], paths)] if args.join else [(s, [p]) for s, p in zip(stems, paths, strict=True)]
    rows = []
    with _progress(jobs) as (share, done):
        for stem, files in jobs:
            try:
                rows.append({"log": stem, **_ingest(files, stem, args.out, names, attachments, share)})
            except (DynoscopeError, OSError, MemoryError) as error:
                rows.append({"log": stem, "status": "failed", "reason": str(error) or type(error).__name__})
            done(f"{stem}: {rows[-1]['status']}")
    if args.json:
        print_json(rows)
    else:
        columns = ("log", "status", "seconds", "rows", "signals", "notes", "reason")
        print_table(rows, {c: c for c in columns if any(row.get(c) is not None for row in rows)})
    return 1 if any(row["status"] == "failed" for row in rows) else 0


def _ingest(
    files: Sequence[Path],
    stem: str,
    out: Path,
    names: NameMap | None,
    attachments: Mapping[str, bytes],
    share: Callable[[float], None],
) -> dict[str, Any]:
    from ingest.continued import read_continued
    from ingest.convert import convert
    from ingest.files import read_blocks

    parts = read_continued(files, names, share) if len(files) > 1 else read_blocks(files[0], names, share)
    report, written = convert(parts, out, stem, attachments)
    start, end = report["span_s"] or (0.0, 0.0)
    return {
        "status": "salvaged" if report["salvaged"] else "ok",
        "reason": "; ".join(report["salvaged"]) or None,
        "seconds": end - start,
        "rows": sum(g["rows"] for g in report["groups"].values()),
        "signals": len(report["signals"]),
        "notes": "; ".join(report["notes"]) or None,
        "files": [str(p) for p in written],
    }


@contextmanager
def _progress(
    jobs: Sequence[tuple[str, Sequence[Path]]],
) -> Iterator[tuple[Callable[[float], None], Callable[[str], None]]]:
    """Functions to tell the share of the present log that is read, and that it is done with a word on it."""
    from pipeline.console import progress, talk

    if not sys.stderr.isatty():
        with progress("ingesting", len(jobs)) as step:
            yield lambda share: None, step
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    sizes = [sum(p.stat().st_size for p in files if p.is_file()) for _, files in jobs]
    parts = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*parts, console=Console(stderr=True), redirect_stdout=False) as bar:
        task = bar.add_task("ingesting", total=max(1, sum(sizes)))
        finished: list[str] = []

        def share(part: float) -> None:
            number = len(finished)
            bar.update(task, completed=sum(sizes[:number]) + part * sizes[number])

        def done(word: str) -> None:
            finished.append(word)
            bar.update(task, completed=sum(sizes[: len(finished)]))
            talk(word)

        yield share, done
