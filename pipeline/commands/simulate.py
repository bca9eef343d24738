"""``dynoscope simulate``: a log with ground truth."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ingest.errors import DynoscopeError

if TYPE_CHECKING:
    from ingest.log import Log
    from ingest.simulators.faults import Fault

HELP = "simulate a log with ground truth; the suffix (.mcap .parquet .csv) picks the format"
SYSTEMS = ("airpath", "throttle", "example1", "example2")
AIRPATH_ONLY = ("cycle", "tolerance", "egr")
NOT_OF_EXAMPLES = (*AIRPATH_ONLY, "fault", "duration", "set")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("system", choices=SYSTEMS, help="what to simulate")
    parser.add_argument("--out", required=True, type=Path, metavar="FILE", help="the log to write")
    parser.add_argument(
        "--cycle",
        help="airpath: wltc_3b (the default) udds us06 hwfet ftp75 nedc, or a CSV of time and speed",
    )
    for name, kind, text in (
        ("fault", str, "the i-th --fault, --magnitude, --onset ... belong together"),
        ("magnitude", float, "size of the fault: relative, mm or %%"),
        ("onset", float, "s; default: a third of the log"),
        ("ramp", float, "s over which the fault grows; default 0"),
        ("end", float, "s at which the fault ends; default: never"),
        ("signal", str, "which signal, for the faults sensor_*"),
    ):
        parser.add_argument(f"--{name}", action="append", default=[], type=kind, help=text)
    parser.add_argument("--tolerance", type=int, choices=(0, 1, 2), help="airpath: spread between vehicles")
    parser.add_argument("--egr", action="store_true", help="airpath: with exhaust gas recirculation")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--n", type=int, metavar="N", help="example1, example2: samples; default 4000")
    parser.add_argument(
        "--duration", type=float, metavar="S", help="s; default: the cycle's own; throttle: 50"
    )
    parser.add_argument(
        "--noise", type=float, default=1.0, metavar="X", help="factor on all measurement noise"
    )
    parser.add_argument(
        "--set", nargs="+", action="extend", default=[], metavar="NAME=VALUE", help="parameters"
    )


def run(args: argparse.Namespace) -> int:
    from ingest import write_log
    from pipeline.console import talk

    make = {"airpath": _airpath, "throttle": _throttle}.get(args.system, _example)
    if args.n is not None and make is not _example:
        raise DynoscopeError(f"simulate {args.system}: --n belongs to example1 and example2; use --duration")
    log = make(args)
    write_log(log, args.out)
    start, end = log.span
    talk(f"wrote {args.out}: {end - start:.0f} s, {len(log.signals)} signals")
    return 0


def _airpath(args: argparse.Namespace) -> Log:
    from ingest.simulators.airpath import simulate_airpath

    return simulate_airpath(
        cycle=args.cycle or "wltc_3b", faults=faults(args), tolerance=args.tolerance or 0, egr=args.egr,
        seed=args.seed, duration_s=args.duration, noise=args.noise, overrides=overrides(args.set),
        name=args.out.stem,
    )  # fmt: skip


def _throttle(args: argparse.Namespace) -> Log:
    from ingest.simulators.throttle import simulate_throttle

    _refuse(args, AIRPATH_ONLY)
    return simulate_throttle(
        faults=faults(args), seed=args.seed, duration_s=50.0 if args.duration is None else args.duration,
        noise=args.noise, overrides=overrides(args.set), name=args.out.stem,
    )  # fmt: skip


def _example(args: argparse.Namespace) -> Log:
    from ingest.simulators.examples import simulate_example

    _refuse(args, NOT_OF_EXAMPLES)
    n = 4000 if args.n is None else args.n
    return simulate_example(args.system, n=n, noise=args.noise, seed=args.seed, name=args.out.stem)


def _refuse(args: argparse.Namespace, names: tuple[str, ...]) -> None:
    if foreign := [f"--{name}" for name in names if getattr(args, name) not in (None, False, [])]:
        raise DynoscopeError(
            f"simulate {args.system}: {', '.join(foreign)} belongs to another system; leave it out"
        )


def faults(args: argparse.Namespace) -> list[Fault]:
    """The faults of the command line, matched by their order.

    Raises:
        DynoscopeError: an option without its fault, or a fault without a magnitude.
    """
    from ingest.simulators.faults import Fault

    count = len(args.fault)
    fields = {
        "magnitude": args.magnitude,
        "onset": args.onset,
        "ramp": args.ramp,
        "end": args.end,
        "signal": args.signal,
    }
    if extra := [f"--{name}" for name, values in fields.items() if len(values) > count]:
        raise DynoscopeError(f"more {', '.join(extra)} than --fault; the i-th of each belong together")
    if len(args.magnitude) < count:
        raise DynoscopeError(
            f"{count} --fault but {len(args.magnitude)} --magnitude; give one each, in order"
        )

    def at(name: str, i: int, default: Any) -> Any:
        return fields[name][i] if i < len(fields[name]) else default

    return [
        Fault(
            name=name,
            magnitude=args.magnitude[i],
            onset_s=at("onset", i, None),
            ramp_s=at("ramp", i, 0.0),
            end_s=at("end", i, None),
            signal=at("signal", i, None),
        )
        for i, name in enumerate(args.fault)
    ]


def overrides(pairs: list[str]) -> dict[str, float]:
    """``name=value`` pairs.

    >>> overrides(["CdA=0.9"])
    {'CdA': 0.9}

    Raises:
        DynoscopeError: a pair that is none.
    """
    out = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        try:
            out[name] = float(value)
        except ValueError:
            raise DynoscopeError(f"--set {pair!r}: expected name=value with a number") from None
    return out
