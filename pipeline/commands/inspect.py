"""``dynoscope inspect``: what a log holds."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

HELP = "show a log's channels, units, rates, gaps, quality flags and, if it has one, its ground truth"
WHOLE_BYTES = 256_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", metavar="LOG", type=Path)
    parser.add_argument("--map", type=Path, help="TOML file that names and converts the log's channels")
    parser.add_argument(
        "--full", action="store_true", help="read and check all of a file above 256 MB, not only its header"
    )
    parser.add_argument("--json", action="store_true", help="print everything as JSON")


def run(args: argparse.Namespace) -> int:
    from ingest.files import find_logs, read_header, read_log
    from ingest.report import describe
    from pipeline.console import print_json, talk

    (path, *more) = find_logs([args.log])
    if more:
        talk(f"{args.log} means {len(more) + 1} logs; this is the first, {path}")
    whole = args.full or path.stat().st_size <= WHOLE_BYTES
    if not whole:
        talk(
            f"{path} is larger than {WHOLE_BYTES // 10**6} MB: header only; --full reads and checks all of it"
        )
    report = describe(read_log(path, args.map) if whole else read_header(path, args.map))
    report["checked"] = "whole file" if whole else "header"
    if args.json:
        print_json(report)
    else:
        _print(report)
    return 0


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
    order = {"duplicates": "duplicates", "out_of_order": "out of order"}
    print_table(
        [{"g": k, **_short(g)} for k, g in report["groups"].items()], {"g": "group", **clock, **order}
    )
    print()
    signals = [{"s": k, **_short(s)} for k, s in report["signals"].items()]
    about = {"s": "signal", "group": "group", "unit": "unit", "unit_from": "from", "dtype": "type"}
    values = {"missing_share": "missing", "min": "min", "max": "max", "flags": "flags"}
    print_table(signals, {**about, "rows": "rows", "rate_hz": "Hz", "gaps": "gaps", **values})
    for title, lines in (("salvaged", report["salvaged"]), ("note", report["notes"])):
        for line in lines:
            print(f"{title}: {line}")
    if report["events"]:
        print()
        columns = ("t_start", "t_end", "kind", "channel", "magnitude", "unit", "confidence", "source")
        print_table(report["events"], {c: c for c in columns})


def _short(entry: dict[str, Any]) -> dict[str, Any]:
    """An entry with its lists as words."""
    gap = entry["longest_gap"]
    flags = [*entry.get("flags", ()), *(["constant"] if entry.get("constant") else [])]
    return {**entry, "longest_gap": gap and "{:.6g} … {:.6g}".format(*gap), "flags": ", ".join(flags)}
