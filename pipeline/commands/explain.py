"""``dynoscope explain``: where a number comes from."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

HELP = "where a file of a run, a summary or a detector comes from, back to the logs"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", type=Path, help="a file, or a run's folder")
    parser.add_argument("--json", action="store_true", help="print all of it as JSON")


def run(args: argparse.Namespace) -> int:
    from pipeline.console import print_json
    from pipeline.lineage import explain

    found = explain(args.file)
    if args.json:
        print_json(found)
    else:
        print("\n".join(lines(found)))
    return 0


def lines(found: Mapping[str, Any]) -> Iterator[str]:
    """The lineage in words, from the file back to the logs."""
    yield f"{found.get('file', found.get('folder'))}: {found.get('what', 'a run')}"
    if "sha256" in found:
        yield f"  sha256 {found['sha256']}"
    if "made" in found:
        yield from _run_lines(found)
    for entry in found.get("runs", ()):
        yield f"  <- {entry['log']}: {entry['manifest']} (key {entry['key']})"
    if "training" in found:
        yield f"  recipe {found['recipe']}, fitted {found['created']}, key {found['key']}"
        if "challenges" in found:
            yield f"  challenges {found['challenges']}, {found['how']}"
        if "calibrated_from" in found:
            rate = found.get("false_alarms", {}).get("per_h")
            wanted = "" if rate is None else f", for {rate:g} false alarms per hour"
            yield f"  models of {found['calibrated_from']}, calibrated anew{wanted}"
        yield from _log_lines(found)


def _run_lines(found: Mapping[str, Any]) -> Iterator[str]:
    made, source = found["made"], found["source"]
    state = (
        f", commit {source['commit'][:12]}{' with changes' if source['changed'] else ''}" if source else ""
    )
    yield f"  made {made.get('started')} by dynoscope {found['packages'].get('dynoscope')}{state}"
    versions = [f"{k} {v}" for k, v in found["packages"].items() if k != "dynoscope"]
    yield f"  with Python {found['python']}, {', '.join(versions)}"
    for step in found["steps"]:
        settings = {k: v for k, v in step["settings"].items() if v not in ({}, [], None)}
        yield f"  <- {step['stage']} version {step['version']} ({step['output'][:12]})"
        if step.get("adds"):
            yield f"       adds {' '.join(step['adds'])}"
        yield f"       {', '.join(f'{k} = {v}' for k, v in settings.items())}"
    log, detector = found["log"], found["detector"]
    yield f"  <- log {log.get('file')} ({log.get('format', 'dynoscope')}), sha256 {log.get('sha256')}"
    yield f"       read from {log.get('path')}: {log['now']}"
    yield f"  with detector {detector['key']} of recipe {detector['recipe']}"
    yield from _log_lines(detector)


def _log_lines(detector: Mapping[str, Any]) -> Iterator[str]:
    for kind in ("training", "calibration"):
        for log in detector[kind]:
            digest = f", sha256 {log['sha256']}" if "sha256" in log else ""
            yield f"       <- {kind} {log['log']}, {log['start_s']:g} to {log['end_s']:g} s{digest}"
    for note in detector.get("notes", ()):
        yield f"       {note}"
