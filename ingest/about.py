"""What a file of ours says about its log beside the numbers: one JSON text."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from ingest.errors import LogError
from ingest.log import Log, Signal

VERSION = 1


def about_json(log: Log, rows: Mapping[str, int] | None = None, **more: Any) -> str:
    """Name, groups with rows and signals, flags and facts of ``log``, and what a format has no place for.

    ``rows`` of each group, where ``log`` does not hold them any more.

    Raises:
        LogError: a fact is not a JSON value.
    """
    rows = rows or {k: g.frame.height for k, g in log.groups.items()}
    groups = {k: {"rows": rows[k], "signals": list(g.signals)} for k, g in log.groups.items()}
    about = {
        "version": VERSION,
        "name": log.name,
        "groups": groups,
        "facts": dict(log.facts),
        "flags": {n: list(s.flags) for n, s in log.signals.items() if s.flags},
        **more,
    }
    try:
        return json.dumps(about, ensure_ascii=False)
    except (TypeError, ValueError) as error:
        raise LogError(
            f"log {log.name!r}: the facts cannot be written: {error}; expected JSON values"
        ) from error


def parse_about(where: str, text: str | bytes) -> dict[str, Any]:
    """The inverse of :func:`about_json`.

    Raises:
        LogError: not such a text, or of a newer version.
    """
    try:
        about = dict(json.loads(text))
        version = int(about["version"])
    except (KeyError, TypeError, ValueError) as error:
        raise LogError(f"{where}: the description of the log is damaged: {error!r}") from error
    if version > VERSION:
        raise LogError(
            f"{where} was written by a newer dynoscope (format {version}, known {VERSION}); update dynoscope"
        )
    return about


def with_flags(signals: Mapping[str, Signal], about: Mapping[str, Any]) -> dict[str, Signal]:
    """Signals with the flags they had in the end; a column's own metadata are written before the rows."""
    return {n: replace(s, flags=tuple(about["flags"].get(n, ()))) for n, s in signals.items()}
