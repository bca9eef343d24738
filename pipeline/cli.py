"""The command line: one parser, one module a command. Nothing heavy is imported before a command runs."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from ingest.errors import DynoscopeError

COMMANDS = (
    "demo", "simulate", "ingest", "inspect", "identify", "select", "fit", "run", "replay", "view", "recipe",
    "cache", "explain", "detectors", "report", "export",
    "retrain", "replay-check", "drift", "adapt",
)  # fmt: skip
DONE, FAILED, WRONG = 0, 1, 2


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status: 0 done, 1 some logs failed, 2 nothing was started."""
    parser = build_parser()
    args = parser.parse_args(argv)
    try:
        check_packages()
        return int(args.run(args))
    except DynoscopeError as error:
        if args.debug:
            raise
        print(f"dynoscope {args.command}: {error}", file=sys.stderr)
        return WRONG
    except BrokenPipeError:  # the reader of our output has gone, as in `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except KeyboardInterrupt:
        print(f"dynoscope {args.command}: stopped", file=sys.stderr)
        return 130


def build_parser() -> argparse.ArgumentParser:
    """The parser with all commands."""
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--debug", action="store_true", help="show the traceback of an error")
    parser = argparse.ArgumentParser(
        prog="dynoscope",
        description="Replays engine and dynamometer logs and shows which sensor or component is failing.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in COMMANDS:
        module = import_module(f"pipeline.commands.{name.replace('-', '_')}")
        command = commands.add_parser(name, help=module.HELP, description=module.HELP, parents=[common])
        module.add_arguments(command)
        command.set_defaults(run=module.run)
    return parser


def check_packages() -> None:
    """The four packages have plain names, so another distribution's may stand in front of ours.

    Raises:
        DynoscopeError: one of them lies elsewhere.
    """
    home = Path(__file__).resolve().parents[1]
    for name in ("ingest", "stages", "viz"):
        spec = find_spec(name)
        place = Path(spec.origin).resolve().parents[1] if spec and spec.origin else None
        if place != home:
            raise DynoscopeError(
                f"package {name!r} is loaded from {place}, dynoscope lies in {home}; another distribution "
                "has that name: install dynoscope in an environment of its own"
            )


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        print(f"dynoscope {version('dynoscope')}")
        parser.exit()


if __name__ == "__main__":
    sys.exit(main())
