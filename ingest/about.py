"""What a file of ours says about its log beside the numbers: one JSON text."""

from __future__ import annotations

import json
from typing import Any

from ingest.errors import LogError
from ingest.log import Log

VERSION = 1


def about_json(log: Log, **more: Any) -> str:
    """Name, groups with their rows and signals, and facts of ``log``, and what a format has no place for.

    Raises:
        LogError: a fact is not a JSON value.
    """
    groups = {k: {"rows": g.frame.height, "signals": list(g.signals)} for k, g in log.groups.items()}
    about = {
        "version": VERSION,
        "name": log.name,
        "groups": groups,
        "facts": dict(log.facts),
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
