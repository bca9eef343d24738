"""The static report of a batch: one HTML file that needs nothing else, light or dark as the reader's screen.

The table of all verdicts, what became of the known truth, the matrices, vehicles, and a section for each log.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import polars as pl

from stages.results import Chosen, Diagnosis, Magnitude
from viz.colours import hex_of, of_fault
from viz.drift import Drifted, drift_part
from viz.lanes import regime_name
from viz.plots import distribution_plot, matrices_plot, timeline_plot
from viz.selection_plot import selection_plot
from viz.sheet import sheet
from viz.statistics import in_alarm, leads, regime_signature, signature
from viz.summary import magnitude_text, summary
from viz.svg import style, themed
from viz.tables import confusion, judged, shaded, table
from viz.wear import Worn, wear_part

VERSION = 5
"""Of a section's looks; another one is drawn anew."""
QUIET = ("none", "insufficient_evidence")
Row = Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class Section:
    """What the report says of one log: drawn from its run, or taken from an earlier report."""

    log: str
    key: str
    """Of the run it was drawn from."""
    fault: str
    signature: Mapping[str, float]
    leads: Mapping[str, float]
    html: str

    def text(self) -> str:
        """The section as it stands in the report, from which :func:`sections` has it back."""
        told = {k: v for k, v in vars(self).items() if k != "html"}
        head = json.dumps({**told, "version": VERSION}).replace("-->", "")
        return f"<!--section {head}-->\n{self.html}\n<!--/section-->"


def section(diagnosis: Diagnosis, key: str) -> Section:
    """Words and plots of one log."""
    verdict, samples = diagnosis.verdict, diagnosis.samples
    with style():
        plots = [themed(timeline_plot(diagnosis))]
        if in_alarm(samples).any():  # of a quiet log they would say no more
            plots.append(themed(distribution_plot(diagnosis)))
    name = escape(verdict.log)
    plots.append(_by_regime(samples))
    words = _html(summary(diagnosis)).replace("<h2>", f"<h2><a href='#top'>{name}</a> · ", 1)
    return Section(
        log=verdict.log, key=key, fault=verdict.fault,
        signature=signature(samples), leads=leads(samples, verdict.fault),
        html=f'<section class="log" id="{anchor(verdict.log)}">\n{_placed(words, plots)}</section>',
    )  # fmt: skip


def _by_regime(samples: pl.DataFrame) -> str:
    """The mean of each residual in each regime, in sigma."""
    regimes, shown, means = regime_signature(samples)
    if not regimes:
        return ""
    when = "in alarm" if in_alarm(samples).any() else "over the log"
    told = shaded(means, shown, [regime_name(r) for r in regimes], limit=6.0)
    return f'<p class="soft">Mean z {when} by regime: how many sigma each residual is off</p>{told}'


def _placed(words: str, plots: Sequence[str]) -> str:
    """Heading and facts above the plots, the rest of the words below."""
    head, rest = words.split("<h3>", 1) if "<h3>" in words else (words, "")
    rest = "".join(f"<div><h3>{part}</div>" for part in rest.split("<h3>")) if rest else ""
    return f'{head}{"".join(plots)}<div class="words">{rest}</div>'


def _html(markdown: str) -> str:
    from markdown_it import MarkdownIt

    return str(MarkdownIt("commonmark", {"html": False}).enable("table").render(markdown))


def anchor(log: str) -> str:
    """An id for a log's section."""
    return "log-" + re.sub(r"[^A-Za-z0-9_-]", lambda c: f".{ord(c[0]):x}", log)


def sections(report: str) -> Iterator[Section]:
    """The sections of an earlier report that this version would draw the same."""
    for head, html in re.findall(r"<!--section (.*?)-->\n(.*?)\n<!--/section-->", report, flags=re.DOTALL):
        told = json.loads(head)
        if told.pop("version", None) == VERSION:
            yield Section(html=html, **told)


def report(
    title: str,
    rows: Sequence[Row],
    drawn: Sequence[Section],
    fleet: pl.DataFrame,
    notes: Sequence[str] = (),
    selections: Sequence[Chosen] = (),
    drift: Drifted | None = None,
    worn: Sequence[Worn] = (),
) -> str:
    """The whole page. ``rows``: of the summary; ``drawn``: sections of some of their logs; ``selections``:
    of the detector's inputs; ``drift`` and the wear of vehicles (``worn``): from log to log."""
    known = {s.log for s in drawn}
    parts = [
        f'<h1 id="top">{escape(title)}</h1>',
        *(f'<p class="soft">{escape(note)}</p>' for note in notes),
        _cards(rows),
        "<h2>Verdicts</h2>",
        _filters(rows),
        _verdicts(rows, known),
        _truth(rows),
        _matrices(drawn),
        _fleet(fleet),
        drift_part(drift) if drift else "",
        wear_part(worn) if worn else "",
        *(s.text() for s in drawn),
        _selections(selections),
    ]
    return sheet(title, parts)


def _cards(rows: Sequence[Row]) -> str:
    faulty = sum(bool(r["fault"]) and r["fault"] not in QUIET for r in rows)
    failed = sum(r["status"] == "failed" for r in rows)
    hours = sum(r["duration_s"] or 0.0 for r in rows) / 3600.0
    told = [judged(r) for r in rows if r["truth"]]
    counts = {
        "logs": len(rows), "with a fault": faulty, "fault-free": sum(r["fault"] == "none" for r in rows),
        "too little data": sum(r["fault"] == "insufficient_evidence" for r in rows),
        "failed": failed, "hours": f"{hours:.3g}",
    }  # fmt: skip
    if told:
        counts["right of those whose truth is known"] = f"{told.count('correct')} / {len(told)}"
    cards = (f'<div class="card"><b>{v}</b>{k}</div>' for k, v in counts.items() if v not in (0, "0"))
    return f'<div class="cards">{"".join(cards)}</div>'


def _filters(rows: Sequence[Row]) -> str:
    def choice(name: str, head: str) -> str:
        values = sorted({str(r[name]) for r in rows if r[name]})
        options = "".join(f'<option value="{escape(v)}">{escape(v)}</option>' for v in values)
        return f'<select name="{name}" aria-label="{head}"><option value="">{head}</option>{options}</select>'

    search = '<input id="text" type="search" placeholder="log, vehicle, words …" aria-label="search">'
    shown = [n for n in ("fault", "status", "vehicle") if len({r[n] for r in rows}) > 1]
    choices = "".join(choice(n, f"every {n}") for n in shown)
    return f'<div class="tools">{search}{choices}<span id="count" class="soft" role="status"></span></div>'


def _verdicts(rows: Sequence[Row], known: set[str]) -> str:
    columns = {
        "log": "log", "fault": "verdict", "truth": "truth", "right": "right?", "signal": "sensor", "p": "p",
        "onset_s": "onset s", "detected_s": "detected s", "magnitude": "size", "usable_s": "usable s",
        "vehicle": "vehicle", "fault_codes": "fault codes", "mil": "lamp",
        "status": "status", "reason": "remark",
    }  # fmt: skip
    cells = [{c: _cell(c, row, known) for c in columns} for row in rows]
    shown = [c for c in columns if c in ("log", "fault") or any(cell[c][1] for cell in cells)]
    if len({r["vehicle"] for r in rows}) == 1 and len(rows) > 1:
        shown = [c for c in shown if c != "vehicle"]  # the same throughout says nothing
    data = [
        f'data-fault="{escape(str(r["fault"] or ""))}" data-status="{escape(r["status"])}" '
        f'data-vehicle="{escape(str(r["vehicle"] or ""))}"'
        for r in rows
    ]
    return table(
        [columns[c] for c in shown], [[cell[c][0] for c in shown] for cell in cells], data, "verdicts"
    )


def _cell(name: str, row: Row, known: set[str]) -> tuple[str, bool]:
    """A cell of the table and whether it says anything."""
    value = judged(row) if name == "right" else row[name]
    if name == "status" and value == "ok":
        return "<td>ok</td>", False
    if value is None or value is False or value == "":
        return '<td data-v=""></td>', False
    text = escape(str(value))
    if name == "log" and value in known:
        return f'<td><a href="#{anchor(str(value))}">{text}</a></td>', True
    if name == "fault":
        return f'<td><span class="dot" style="background:{_shade(str(value))}"></span>{text}</td>', True
    if name == "right":
        return f'<td class="{"good" if value == "correct" else "bad"}">{text}</td>', True
    if name == "mil":
        return "<td>on</td>", True
    if name in ("reason", "fault_codes"):
        return f'<td class="why">{text}</td>', True
    if name == "magnitude":
        size = Magnitude(value=float(value), sd=row["magnitude_sd"], unit=row["unit"] or "1")
        return f'<td class="n" data-v="{value:.6g}">{escape(magnitude_text(size))}</td>', True
    if isinstance(value, float):
        return f'<td class="n" data-v="{value:.9g}">{value:.3f}</td>' if name == "p" else (
            f'<td class="n" data-v="{value:.9g}">{value:.1f}</td>'
        ), True  # fmt: skip
    return f"<td>{text}</td>", True


def _shade(fault: str) -> str:
    """The fault's colour, as the theme has it where it is one of the palette."""
    name = hex_of(of_fault(fault))
    return f"var(--{name[1:]},{name})"


def _truth(rows: Sequence[Row]) -> str:
    told = [r for r in rows if r["truth"] and r["fault"]]
    return f"<h2>Against the truth</h2>\n{confusion(told)}" if told else ""


def _matrices(drawn: Sequence[Section]) -> str:
    found: dict[str, list[Section]] = {}
    for one in drawn:
        if one.fault not in QUIET:
            found.setdefault(one.fault, []).append(one)
    with style():
        figure = matrices_plot(
            {f: _mean([s.signature for s in many]) for f, many in sorted(found.items())},
            {f: _mean([s.leads for s in many]) for f, many in sorted(found.items())},
        )
        drawing = themed(figure) if figure is not None else ""
    return f"<h2>Signatures and isolability, by verdict</h2>\n{drawing}" if drawing else ""


def _selections(chosen: Sequence[Chosen]) -> str:
    with style():
        parts = [
            f"<h3>{escape(one.name)}: {escape(', '.join(one.taken)) or 'nothing'}</h3>"
            f"{themed(selection_plot(one))}"
            for one in chosen
        ]
    return f"<h2>What the inputs were selected on</h2>\n{''.join(parts)}" if parts else ""


def _mean(several: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """By name, the mean over those that have it."""
    names = dict.fromkeys(n for one in several for n in one)
    return {n: sum(values) / len(values) for n in names if (values := [o[n] for o in several if n in o])}


def _fleet(fleet: pl.DataFrame) -> str:
    if fleet.height == 0 or fleet["vehicle"].null_count() == fleet.height:
        return ""
    columns = {
        "vehicle": "vehicle", "logs": "logs", "failed": "failed", "none": "fault-free",
        "faulty": "with a fault", "hours": "hours", "faults": "faults named",
        "fault_codes": "fault codes after the last log", "mil": "lamp",
    }  # fmt: skip
    rows = fleet.with_columns(mil=pl.when("mil").then(pl.lit("on"))).fill_null("").iter_rows(named=True)
    long = ("faults", "fault_codes")
    body = [
        [f'<td class="{"why" if c in long else ""}">{escape(str(row[c]))}</td>' for c in columns]
        for row in rows
    ]
    head = "<h2>Vehicles, as on-board diagnosis sees them</h2>"
    return head + table(list(columns.values()), body, [""] * len(body), "vehicles")
