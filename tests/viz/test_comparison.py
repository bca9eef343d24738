from __future__ import annotations

import re
from typing import Any

from viz.comparison import comparison_page, comparison_plot
from viz.svg import style


def row(what: str, of: str = "", **told: Any) -> dict[str, Any]:
    numbers = dict.fromkeys(("champion", "challenger", "difference", "low", "high", "drives", "verdict"))
    return {"what": what, "of": of, "size": None, "unit": "", "pooled": False, **numbers, **told}


def between(low: float, high: float, verdict: str) -> dict[str, Any]:
    middle = (low + high) / 2
    told = {"champion": 0.9, "challenger": 0.9 + middle, "difference": middle, "low": low, "high": high}
    return {**told, "drives": 6, "verdict": verdict}


ROWS = [
    row("detected", pooled=True, **between(-0.3, -0.1, "worse")),
    row("detected", "boost_leak +4 <mm>", **between(-0.1, 0.3, "undecided")),
    row("residual sigma", "r_cyl in regime 3", **between(0.1, 0.2, "worse")),
    row("delay", **{**between(0.0, 1.0, "undecided"), "low": None, "high": None}),
    row("size", unit="KiB", champion=12.0, challenger=13.5),
]
FOUND = {"champion": "a" * 16, "challenger": "b" * 16, "hours": 2.5, "verdict": "worse"}
FOUND |= {"logs": ["d1", "d2"], "rows": ROWS}


def test_the_page_has_every_row_with_its_interval_and_verdict() -> None:
    page = comparison_page(FOUND, "fewer faults are <found>")
    assert "The challenger is worse</b>: fewer faults are &lt;found&gt;" in page
    assert "boost_leak +4 &lt;mm&gt;" in page
    assert "-0.3 … -0.1" in page
    assert "? … ?" in page
    tables = re.findall(r'<table class="sortable" id="(\w+)">(.*?)</table>', page, flags=re.DOTALL)
    rows = {name: body.split("<tbody>")[1].count("<tr ") for name, body in tables}
    assert rows == {"comparison": 4, "regimes": 1}
    assert page.count("<svg") == 1
    assert "http" not in re.sub(r"http://www.w3.org/[\w/.]*", "", page)


def test_what_has_no_interval_is_not_drawn() -> None:
    with style():
        drawn = comparison_plot([r for r in ROWS if "regime" not in r["of"]])
    assert drawn is not None
    assert [ax.get_title(loc="left").split(":")[0] for ax in drawn.axes] == ["detected"]
    assert [t.get_text() for t in drawn.axes[0].get_yticklabels()] == ["all *", "boost_leak +4 <mm>"]
    assert comparison_plot(ROWS[3:]) is None
