"""``dynoscope inspect``: what a log holds."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pipeline.commands.ingest import add_map_arguments, names_of

HELP = "show a log's channels, units, rates, gaps, quality flags and, if it has one, its ground truth"
WHOLE_BYTES = 256_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", metavar="LOG", help="a file or URL")
    add_map_arguments(parser)
    parser.add_argument(
        "--save-map",
        type=Path,
        metavar="FILE",
        help="write the map that is proposed, to be checked and edited",
    )
    parser.add_argument(
        "--full", action="store_true", help="read and check all of a file above 256 MB, not only its header"
    )
    parser.add_argument("--json", action="store_true", help="print everything as JSON")


def run(args: argparse.Namespace) -> int:
    from ingest.files import find_logs, read_header
    from ingest.proposal import as_toml, propose
    from ingest.report import describe
    from pipeline.console import print_json, talk

    names = names_of(args)
    (path, *more) = find_logs([args.log])
    if more:
        talk(f"{args.log} means {len(more) + 1} logs; this is the first, {path}")
    whole = args.full or path.stat().st_size <= WHOLE_BYTES
    if whole:
        log, report = _read(path, names)
    else:
        talk(
            f"{path} is larger than {WHOLE_BYTES // 10**6} MB: header only; --full reads and checks all of it"
        )
        log = read_header(path, names)
        report = describe(log)
    report["checked"] = "whole file" if whole else "header"
    report["proposed"] = proposed = propose(log)
    if args.save_map:
        _save(args.save_map, as_toml(log, proposed))
        talk(f"{args.save_map}: {len(proposed)} signals proposed; check every line before you use it")
    if args.json:
        print_json(report)
    else:
        _print(report)
    return 0


def _read(path: Path, names: Any) -> tuple[Any, dict[str, Any]]:
    """What is known of the log, with the rows of its first part, and the report on all of it."""
    from ingest.blocks import follow
    from ingest.files import read_blocks
    from ingest.quality import Quality
    from ingest.report import describe

    found, first, whole = Quality(), None, None
    for part in read_blocks(path, names):
        found.add(part)
        first = first or part
        whole = part if whole is None else follow(whole, part)
    assert whole is not None  # a log has at least one part
    return first, describe(whole, found)


def _save(path: Path, text: str) -> None:
    from ingest.errors import MapError

    if path.exists():
        raise MapError(f"map {path} is there already; name another file, or remove it first")
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise MapError(f"map {path} cannot be written: {error.strerror or error}") from error


def _print(report: dict[str, Any]) -> None:
    from pipeline.console import print_table

    facts = {"log": report["log"], "checked": report["checked"], **report["facts"]}
    if report["span_s"]:
        facts["time"] = "{:.6g} … {:.6g} s".format(*report["span_s"])
    print_table(
        [{"k": k, "v": v if isinstance(v, str) else repr(v)} for k, v in facts.items()],
        {"k": "fact", "v": ""},
    )
    print()
    clock = {
        "rows": "rows",
        "rate_hz": "Hz",
        "jitter": "jitter",
        "gaps": "gaps",
        "longest_gap": "longest gap s",
    }
    order = {"duplicates": "duplicates", "out_of_order": "out of order", "clock_jumps": "clock jumps"}
    groups = [{"g": k, **_short(g)} for k, g in report["groups"].items()]
    print_table(groups, {"g": "group", **clock, **order})
    print()
    signals = [{"s": k, **_short(s)} for k, s in report["signals"].items()]
    about = {
        "s": "signal",
        "group": "group",
        "unit": "unit",
        "unit_from": "from",
        "dtype": "type",
        "kind": "kind",
    }
    values = {"missing_share": "missing", "min": "min", "max": "max", "flags": "flags"}
    print_table(signals, {**about, "rows": "rows", "rate_hz": "Hz", "gaps": "gaps", **values})
    for title, lines in (("salvaged", report["salvaged"]), ("note", report["notes"])):
        for line in lines:
            print(f"{title}: {line}")
    if report["proposed"]:
        pairs = ", ".join(f"{s} = {c}" for s, c in report["proposed"].items())
        print(f"\nproposed, not applied: {pairs}; --save-map FILE writes a map to check and edit")
    if report["events"]:
        print()
        columns = ("t_start", "t_end", "kind", "channel", "magnitude", "unit", "confidence", "source")
        print_table(report["events"], {c: c for c in columns})


def _short(entry: dict[str, Any]) -> dict[str, Any]:
    """An entry with its lists, and the counts of what is suspicious, as words."""
    gap = entry["longest_gap"]
    counts = [f"{entry[k]} {k}" for k in ("stuck", "clipped", "spikes") if entry.get(k)]
    flags = [*entry.get("flags", ()), *(["constant"] if entry.get("constant") else []), *counts]
    return {**entry, "longest_gap": gap and "{:.6g} … {:.6g}".format(*gap), "flags": ", ".join(flags)}
