"""A comparison of two detectors as a page of its own: what differs, how surely, and what follows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from viz.colours import BLUE, GREY, VERMILLION, hex_of
from viz.sheet import sheet
from viz.svg import style, themed
from viz.tables import table

INCHES = 9.6
COLOURS = {"better": BLUE, "worse": VERMILLION}
REGIME = " in regime "
"""In the name of a row that is of a single regime."""
Row = Mapping[str, Any]


def comparison_page(found: Mapping[str, Any], because: str) -> str:
    """``found``: what ``detectors compare --json`` prints; ``because``: why its verdict is that."""
    champion, challenger = (str(found[k])[:12] for k in ("champion", "challenger"))
    verdict, rows = str(found["verdict"]), found["rows"]
    shade = {"better": "good", "not worse": "good", "worse": "bad"}.get(verdict, "soft")
    told = [r for r in rows if REGIME not in r["of"]]
    note = (
        f"Both replayed the same {len(found['logs'])} held-out logs ({found['hours']:.2f} h), as they are "
        "and with injected faults. Differences are counted so that more is better, with the intervals that "
        "the logs leave; rows with * decide, each at a level that keeps a false “worse” of all below 5 %."
    )
    with style():
        drawing = comparison_plot(told)
        svg = themed(drawing) if drawing is not None else ""
    return sheet(
        f"{challenger} against {champion}",
        [
            f'<h1 id="top">Challenger {escape(challenger)} against champion {escape(champion)}</h1>',
            f'<p><b class="{shade}">The challenger is {escape(verdict)}</b>: {escape(because)}</p>',
            f'<p class="soft">{note}</p>', "<h2>Differences</h2>", svg, _table(told, "comparison"),
            "<h2>By regime</h2>" + _table([r for r in rows if r not in told], "regimes")
            if len(told) < len(rows) else "",
            "<h2>Held-out logs</h2><p>" + escape(", ".join(found["logs"])) + "</p>",
        ],
    )  # fmt: skip


def _table(rows: Sequence[Row], name: str) -> str:
    heads = (
        "what",
        "of",
        "unit",
        "champion",
        "challenger",
        "difference",
        "interval",
        "logs",
        "verdict",
        "decides",
    )
    cells = []
    for row in rows:
        numbers = [_number(row[k]) for k in ("champion", "challenger", "difference")]
        interval = "" if row["verdict"] is None else f"{_short(row['low'])} … {_short(row['high'])}"
        shade = {"better": "good", "worse": "bad"}.get(row["verdict"] or "", "")
        cells.append([
            *(f"<td>{escape(str(row[k]))}</td>" for k in ("what", "of", "unit")), *numbers,
            f"<td>{interval}</td>", _number(row["drives"]),
            f'<td class="{shade}">{escape(row["verdict"] or "")}</td>',
            f"<td>{'*' if row['pooled'] else ''}</td>",
        ])  # fmt: skip
    return table(heads, cells, [""] * len(cells), name)


def _number(value: float | None) -> str:
    return "<td></td>" if value is None else f'<td class="n" data-v="{value:.9g}">{value:.4g}</td>'


def _short(value: float | None) -> str:
    return "?" if value is None else f"{value:.3g}"


def comparison_plot(rows: Sequence[Row]) -> Any | None:
    """Differences with their intervals, a plot for each quantity; None where there are none."""
    from matplotlib.figure import Figure

    known = [r for r in rows if None not in (r["verdict"], r["difference"], r["low"], r["high"])]
    kinds = list(dict.fromkeys(r["what"] for r in known))
    if not kinds:
        return None
    counts = [sum(r["what"] == kind for r in known) for kind in kinds]
    height = sum(0.17 * n + 0.5 for n in counts) + 0.2
    figure = Figure(figsize=(INCHES, height))
    axes = figure.subplots(len(kinds), 1, squeeze=False, height_ratios=[0.17 * n + 0.12 for n in counts])
    figure.subplots_adjust(left=0.27, right=0.98, top=1 - 0.25 / height, bottom=0.3 / height, hspace=1.1)
    for ax, kind in zip(axes[:, 0], kinds, strict=True):
        mine = [r for r in known if r["what"] == kind]
        for i, row in enumerate(mine):
            colour = hex_of(COLOURS.get(row["verdict"], GREY))
            width = 2.6 if row["pooled"] else 1.4
            ax.plot([row["low"], row["high"]], [-i, -i], color=colour, linewidth=width)
            ax.plot(row["difference"], -i, "o", color=colour, markersize=3.5)
        ax.axvline(0.0, color=hex_of(GREY), linewidth=0.8)
        ax.set_yticks([-i for i in range(len(mine))], [(r["of"] or "all") + " *" * r["pooled"] for r in mine])
        ax.set_ylim(-len(mine) + 0.4, 0.6)
        ax.margins(x=0.05)
        unit = f" [{mine[0]['unit']}]" if mine[0]["unit"] else ""
        ax.set_title(f"{kind}{unit}: right of 0: the challenger is better")
    return figure
