"""Talking to people: results go to stdout, everything else to stderr; progress bars on a terminal only."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from ingest.errors import DynoscopeError


def talk(message: str) -> None:
    """A plain line to stderr."""
    print(message, file=sys.stderr, flush=True)


def print_json(value: Any) -> None:
    """A result as JSON on stdout."""
    print(json.dumps(value, indent=1, ensure_ascii=False))


def print_table(rows: list[dict[str, Any]], columns: dict[str, str]) -> None:
    """A result as a table on stdout; ``columns`` maps keys to headings, missing values stay empty."""
    cells = [[_cell(row.get(key)) for key in columns] for row in rows]
    if sys.stdout.isatty():
        from rich.console import Console
        from rich.table import Table

        table = Table(*columns.values(), box=None, header_style="bold")
        for row in cells:
            table.add_row(*row)
        Console().print(table)
        return
    lines = [list(columns.values()), *cells]
    width = [max(len(line[i]) for line in lines) for i in range(len(columns))]
    for line in lines:
        print("  ".join(text.ljust(w) for text, w in zip(line, width, strict=True)).rstrip())


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


@contextmanager
def progress(title: str, total: int) -> Iterator[Callable[[str], None]]:
    """Yields a function to call after each of ``total`` steps with a word on it."""
    if not sys.stderr.isatty():
        done = 0

        def line(word: str) -> None:
            nonlocal done
            done += 1
            talk(f"[{done}/{total}] {word}")

        yield line
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    parts = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"), TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*parts, console=Console(stderr=True)) as bar:
        task = bar.add_task(title, total=total, rate="")
        began = time.monotonic()

        def step(word: str) -> None:
            bar.console.print(word)
            done = bar.tasks[task].completed + 1
            bar.update(task, advance=1, rate=f"{60 * done / (time.monotonic() - began):.3g}/min")

        yield step


class Problems:
    """Collects mistakes so that a user sees all of them at once.

    >>> problems = Problems()
    >>> for text in ("3", "x"):
    ...     with problems:
    ...         if not text.isdigit():
    ...             raise DynoscopeError(f"{text!r} is not a number")
    >>> problems.raise_any()
    Traceback (most recent call last):
    ingest.errors.DynoscopeError: 'x' is not a number
    """

    def __init__(self) -> None:
        self.errors: list[DynoscopeError] = []

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> bool:
        if isinstance(error, DynoscopeError):
            self.errors.append(error)
            return True
        return False

    def raise_any(self) -> None:
        """Raise what has been collected, as one error."""
        if len(self.errors) == 1:
            raise self.errors[0]
        if self.errors:
            raise DynoscopeError("\n".join(str(e) for e in self.errors))
