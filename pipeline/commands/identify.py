"""``dynoscope identify``: a linear model from a log."""

from __future__ import annotations

import argparse
from typing import Any

from pipeline.commands.ingest import add_map_arguments, names_of

HELP = "subspace identification of a linear model: poles, time constants, gains, order, fit on held-out data"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", metavar="LOG", help="a file or URL")
    parser.add_argument("--input", nargs="+", action="extend", required=True, metavar="NAME", help="inputs")
    parser.add_argument("--output", nargs="+", action="extend", required=True, metavar="NAME", help="outputs")
    parser.add_argument("--order", type=int, metavar="N", help="default: the one that the data support")
    parser.add_argument("--method", choices=("cva", "moesp", "n4sid"), default="cva")
    parser.add_argument(
        "--horizon", type=int, default=20, metavar="N", help="lags of past and future; default 20"
    )
    parser.add_argument(
        "--raster",
        type=float,
        default=0.0,
        metavar="S",
        help="s between samples; default: the first output's own",
    )
    add_map_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print everything as JSON")


def run(args: argparse.Namespace) -> int:
    from ingest import read_log
    from ingest.files import find_logs
    from pipeline.console import print_json, talk
    from pipeline.identifying import Settings, identify_log

    names = names_of(args)
    (path, *more) = find_logs([args.log])
    if more:
        talk(f"{args.log} means {len(more) + 1} logs; this is the first, {path}")
    settings = Settings(
        inputs=tuple(args.input), outputs=tuple(args.output), order=args.order, method=args.method,
        horizon=args.horizon, raster_s=args.raster,
    )  # fmt: skip
    result = identify_log(read_log(path, names), settings)
    if args.json:
        print_json(result)
    else:
        _print(result)
    return 0


def _print(result: dict[str, Any]) -> None:
    from pipeline.console import print_table

    fit = result["held_out"]
    print(
        f"{result['log']}: order {result['order']} by {result['method']} from {result['samples']} samples of "
        f"{result['sample_s']:.6g} s"
    )
    print("\nPoles")
    heads = {
        "real": "real 1/s", "imaginary": "imaginary 1/s", "time_constant_s": "time constant s",
        "damping": "damping",
    }  # fmt: skip
    print_table(result["poles"], heads)
    print("\nStatic gains, and fit on held-out data (%)")
    rows = [
        {
            "output": output,
            **gains,
            "simulated": fit["simulated_percent"][output],
            "predicted": fit["predicted_percent"][output],
        }
        for output, gains in result["gains"].items()
    ]
    print_table(rows, {key: key for key in rows[0]})
    print("\nOrder")
    criterion = result["criterion"]
    orders = [
        {"order": n, "singular": s, "criterion": criterion[n] if criterion else None}
        for n, s in enumerate(result["singular_values"], start=1)
    ]
    heads = {"order": "order", "singular": "singular value"}
    print_table(orders, heads | ({"criterion": "criterion (least is best)"} if criterion else {}))
