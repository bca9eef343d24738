"""``dynoscope drift``: how a batch's residuals have moved over its logs, and whether to retrain."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "how the residuals of a batch have moved from log to log, and whether to retrain, and why"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("out", type=Path, metavar="OUT", help="the folder of a batch, as `run --out`")
    parser.add_argument("--regimes", action="store_true", help="a line for every regime, too")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run(args: argparse.Namespace) -> int:
    from pipeline.console import print_json, print_table, talk
    from pipeline.drift import ALL, REPORT, TABLE, drift_report

    report = drift_report(args.out)
    talk(f"{TABLE} and {REPORT} are in {args.out}")
    if args.json:
        print_json(report)
        return 0
    rows = []
    for s in report["series"]:
        drift = s["drift"]
        noticed = None if drift["noticed"] is None else report["logs"][drift["noticed"]]
        changes = [report["logs"][part["first"]] for part in drift["segments"][1:]]
        rows.append({
            "residual": s["residual"], "regime": "all" if s["regime"] == ALL else s["regime"],
            "sigma": s["sigma"], "between logs": drift["noise"], "moved": drift["moved"],
            "changes at": ", ".join(changes), "noticed at": noticed,
        })  # fmt: skip
    rows = [r for r in rows if args.regimes or r["regime"] == "all"]
    print_table(rows, {k: k for k in rows[0]} if rows else {})
    print()
    for advice in report["advice"]:
        print(f"since {advice['since']}: {advice['why']}: {advice['do']}")
    if not report["advice"]:
        print("nothing has moved; no reason to retrain")
    return 0
