"""What there is to say against a log's data, in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ingest.log import Log
from viz.lanes import quality_remarks
from viz.series import TRUTH


def shortcomings(quality: Mapping[str, Any]) -> list[str]:
    """What a quality report holds against channels (``{channel: {"gaps": n, ...}}``), and its other numbers.

    >>> shortcomings({"p_Int": {"gaps": 2, "missing": 0}, "T_Int": {"gaps": 0}, "usable_s": 12.0})
    ['usable s: 12', 'gaps: p_Int']
    """
    channels = {name: found for name, found in quality.items() if isinstance(found, Mapping)}
    lines = [f"{k.replace('_', ' ')}: {short(v)}" for k, v in quality.items() if k not in channels]
    for fault in ("gaps", "missing", "duplicates", "out_of_order", "constant"):
        names = [n for n, found in channels.items() if found.get(fault) and not n.startswith(TRUTH)]
        if names:
            lines.append(f"{fault.replace('_', ' ')}: {_listed(names)}")
    return lines


def _listed(names: list[str]) -> str:
    return ", ".join(names[:6]) + (f" … ({len(names)})" if len(names) > 6 else "")


def quality_events(log: Log) -> list[str]:
    """Remarks of the readers on the data, counted by kind and channel."""
    counted: dict[tuple[str, str], int] = {}
    for event in quality_remarks(log):
        key = (event.kind, event.channel or "all channels")
        counted[key] = counted.get(key, 0) + 1
    shown = [f"{kind} × {n} ({channel})" for (kind, channel), n in list(counted.items())[:8]]
    return shown + ([f"… and {len(counted) - 8} more kinds of remarks"] if len(counted) > 8 else [])


def flagged(log: Log) -> list[str]:
    """Signals whose reader left a flag, by flag."""
    by_flag: dict[str, list[str]] = {}
    for name, signal in log.signals.items():
        for flag in signal.flags:
            by_flag.setdefault(flag, []).append(name)
    return [f"{flag}: {_listed(names)}" for flag, names in by_flag.items()]


def short(value: Any) -> str:
    """A fact that fits on a line."""
    if isinstance(value, float):
        return f"{value:.4g}"
    text = str(value)
    return text if len(text) <= 60 else text[:24] + "…"
