"""Tables of the static report, and what a verdict is against the known truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from viz.colours import BLUE, GREEN, VERMILLION, hex_of
from viz.series import Array

Row = Mapping[str, Any]


def judged(row: Row) -> str | None:
    """A summary row's verdict against its truth; None where either is missing.

    >>> judged({"truth": "boost_leak", "fault": "intake_leak", "set": "intake_leak boost_leak"})
    'in the set'
    """
    truth, fault = row["truth"], row["fault"]
    if not truth or not fault:
        return None
    true, named = _parts(truth), _parts(fault)
    if named == true:
        return "correct"
    if true == {"none"}:
        return "no data" if fault == "insufficient_evidence" else "false alarm"
    if fault in ("none", "insufficient_evidence"):
        return "missed"
    return "in the set" if any(_parts(f) == true for f in (row["set"] or "").split()) else "wrong"


def _parts(faults: str) -> set[str]:
    return set(faults.replace("+", " ").split())


def confusion(rows: Sequence[Row]) -> str:
    """Counts of logs by truth (rows) and verdict (columns), the right ones framed."""
    truths = sorted({"+".join(sorted(_parts(r["truth"]))) for r in rows})
    counts = Counter(("+".join(sorted(_parts(r["truth"]))), r["fault"]) for r in rows)
    verdicts = sorted({v for _, v in counts}, key=lambda v: (v not in truths, v))
    body = []
    for truth in truths:
        total = sum(n for (t, _), n in counts.items() if t == truth)
        cells = [f"<th>{escape(truth)}</th>"]
        for verdict in verdicts:
            n, right = counts[truth, verdict], _parts(verdict) == _parts(truth)
            colour = hex_of(GREEN if right else VERMILLION)[1:]
            shade = f"color-mix(in srgb, var(--{colour}) {70 * n / total:.0f}%, transparent)"
            hit = ' class="hit"' if right else ""
            cells.append(f'<td{hit} style="background:{shade}">{n}</td>' if n else f"<td{hit}></td>")
        body.append(f"<tr>{''.join(cells)}</tr>")
    heads = "".join(f"<th>{escape(v)}</th>" for v in verdicts)
    return (
        f'<div class="wide"><table class="confusion"><thead><tr><th>truth \\ verdict</th>{heads}</tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def shaded(values: Array, rows: Sequence[str], heads: Sequence[str], limit: float) -> str:
    """Numbers (rows, heads) on fields from blue (below zero) to vermillion (above), ``limit`` as deep as it
    gets; NaN is an empty field."""
    body = []
    for name, row in zip(rows, values, strict=True):
        cells = [f"<th>{escape(name)}</th>"]
        for value in row.tolist():
            if not np.isfinite(value):
                cells.append("<td></td>")
                continue
            colour, share = hex_of(VERMILLION if value > 0 else BLUE)[1:], min(abs(value) / limit, 1.0)
            shade = f"color-mix(in srgb, var(--{colour}) {100 * share:.0f}%, transparent)"
            text = f"{value:.0f}" if abs(value) >= 9.95 else f"{value:.1f}"
            cells.append(f'<td style="background:{shade}">{text}</td>')
        body.append(f"<tr>{''.join(cells)}</tr>")
    head = "".join(f"<th>{escape(h)}</th>" for h in heads)
    return (
        f'<div class="wide"><table class="confusion"><thead><tr><th></th>{head}</tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], data: Sequence[str], name: str) -> str:
    """A table that can be sorted; ``rows`` are cells in HTML, ``data`` the attributes of each row."""
    head = "".join(f'<th scope="col"><button type="button">{escape(h)}</button></th>' for h in heads)
    body = "\n".join(f"<tr {d}>{''.join(cells)}</tr>" for cells, d in zip(rows, data, strict=True))
    return (
        f'<div class="wide"><table class="sortable" id="{name}"><thead><tr>{head}</tr></thead>\n'
        f"<tbody>{body}</tbody></table></div>"
    )
