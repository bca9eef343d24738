from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from PIL import Image

from stages.results import Diagnosis
from viz.report import Section, report, section, sections
from viz.tables import confusion, judged

Browse = Callable[..., str]
VOID = {"meta", "input", "br", "hr", "img", "link"}


def row(**told: Any) -> dict[str, Any]:
    names = (
        "log status reason recipe detector fault signal set p onset_s detected_s magnitude magnitude_sd unit "
        "usable_s duration_s truth vehicle start_time cycle fault_codes mil"
    )
    return dict.fromkeys(names.split()) | {"status": "ok", "duration_s": 600.0, "recipe": "r"} | told


ROWS = [
    row(
        log="drive_07",
        fault="boost_leak",
        truth="boost_leak",
        p=0.93,
        onset_s=201.3,
        magnitude=3.8,
        unit="mm",
    ),
    row(log="drive_10", fault="none", truth="intake_leak", vehicle="car <1>"),
    row(log="drive_9", fault="boost_leak", truth="intake_leak", p=0.5, set="boost_leak intake_leak"),
    row(log="bad & gone", status="failed", reason="no <samples>"),
]


@pytest.fixture(scope="module")
def drawn(diagnosis: Diagnosis) -> Section:
    return section(diagnosis, "key1")


@pytest.fixture(scope="module")
def page(drawn: Section, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(report("out", ROWS, [drawn], pl.DataFrame({"vehicle": ["car <1>"]} | FLEET)), "utf-8")
    return path


FLEET = {
    "logs": [3], "failed": [0], "none": [1], "faulty": [2], "hours": [0.5], "faults": ["2 boost_leak"],
    "fault_codes": ["boost_leak:confirmed"], "mil": [True],
}  # fmt: skip


class Nesting(HTMLParser):
    """Whether every element is closed where it should be."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.wrong: list[str] = []

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: Any) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID and self.open.pop() != tag:
            self.wrong.append(tag)


def test_the_page_is_whole_and_needs_nothing_else(page: Path) -> None:
    text = page.read_text("utf-8")
    checker = Nesting()
    checker.feed(text)
    assert (checker.open, checker.wrong) == ([], [])
    named = re.findall(r'(?:src|href|xlink:href)="([^"]*)"', text)
    assert [n for n in named if not n.startswith(("#", "data:"))] == []
    assert "@import" not in text
    assert re.findall(r"url\((?!#)", text) == []
    assert len(text) < 250_000


def test_what_logs_say_is_text(page: Path) -> None:
    text = page.read_text("utf-8")
    assert "car <1>" not in text
    assert "no &lt;samples&gt;" in text


def test_sections_are_had_back(drawn: Section, page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (again,) = sections(page.read_text("utf-8"))
    assert again == drawn
    monkeypatch.setattr("viz.report.VERSION", 0)
    assert list(sections(page.read_text("utf-8"))) == []


def test_drawing_depends_on_the_run_only(diagnosis: Diagnosis, drawn: Section) -> None:
    assert section(diagnosis, "key1") == drawn
    other = replace(diagnosis, samples=diagnosis.samples.with_columns(pl.col("z.r_dp") * 2.0))
    assert section(other, "key1") != drawn


def test_what_a_section_says(drawn: Section, diagnosis: Diagnosis) -> None:
    assert drawn.fault == "boost_leak"
    in_alarm = diagnosis.samples.filter(pl.col("detection") == 1)
    for name in ("r_cyl", "r_dp"):
        assert drawn.signature[name] == pytest.approx(in_alarm[f"z.{name}"].mean())
    best = diagnosis.samples.row(
        int(np.argmax(diagnosis.samples["evidence.boost_leak"].to_numpy())), named=True
    )
    lead = best["evidence.boost_leak"] - best["evidence.intake_leak"]
    assert drawn.leads["intake_leak"] == pytest.approx(lead)
    assert drawn.leads["none"] == pytest.approx(best["evidence.boost_leak"])
    assert "Leak in the boost manifold" in drawn.html
    assert drawn.html.count("<svg") == 2
    regime = in_alarm.filter(pl.col("regime") == in_alarm["regime"][0])
    assert f">{float(np.mean(regime['z.r_dp'].to_numpy())):.1f}</td>" in drawn.html


def test_a_quiet_log_is_drawn_with_less(diagnosis: Diagnosis, drawn: Section) -> None:
    samples = diagnosis.samples.with_columns(detection=pl.lit(0, pl.Int8))
    quiet = section(replace(diagnosis, samples=samples), "key1")
    assert quiet.html.count("<svg") == 1
    assert "Mean z over the log by regime" in quiet.html
    assert "Mean z in alarm by regime" in drawn.html


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("rows", [0, 1, 40])
@pytest.mark.parametrize(
    "columns", ["^.*$", "^(time|detection)$", "^(time|detection|regime|residual.*|z.*|sigma.*)$"]
)
def test_little_is_drawn_too(diagnosis: Diagnosis, rows: int, columns: str) -> None:
    samples = diagnosis.samples.select(columns).head(rows)
    drawn = section(replace(diagnosis, samples=samples, operating_map=None), "key")
    assert drawn.html.count("<svg") == 1  # no alarm yet


@pytest.mark.parametrize(
    ("truth", "fault", "others", "said"),
    [
        ("boost_leak", "boost_leak", "", "correct"),
        ("boost_leak maf_gain", "boost_leak+maf_gain", "", "correct"),
        ("boost_leak", "intake_leak", "intake_leak", "wrong"),
        ("boost_leak", "none", "", "missed"),
        ("none", "none", "", "correct"),
        ("none", "boost_leak", "", "false alarm"),
        (None, "boost_leak", "", None),
    ],
)
def test_verdicts_are_judged(truth: str | None, fault: str, others: str, said: str | None) -> None:
    assert judged({"truth": truth, "fault": fault, "set": others}) == said


def test_the_confusion_counts_every_log_once() -> None:
    table = confusion(ROWS[:3])
    cells = [int(n) for n in re.findall(r"<td[^>]*>(\d+)</td>", table)]
    assert sum(cells) == 3
    assert 'class="hit"' in table


def test_it_opens_sorts_and_filters(page: Path, browse: Browse, tmp_path: Path) -> None:
    """Clicks and types in a real browser; what the table then shows is written into its title."""
    script = """<script>
    const body = document.querySelector("#verdicts tbody"), said = [];
    const say = () => said.push([...body.rows].filter(r => !r.hidden).map(r => r.cells[0].textContent) + "");
    const press = n => document.querySelectorAll("#verdicts thead button")[n].click();
    press(0); say(); press(0); say();
    text.value = "boost_leak"; text.dispatchEvent(new Event("input")); say();
    text.value = ""; const fault = document.querySelector("select[name=fault]"); fault.value = "none";
    fault.dispatchEvent(new Event("change")); say();
    document.title = said.join(" | "); </script>"""
    (tmp_path / "t.html").write_text(page.read_text("utf-8").replace("</body>", script + "</body>"), "utf-8")
    dom = browse((tmp_path / "t.html").as_uri(), "--dump-dom")
    title = re.search(r"<title>(.*?)</title>", dom)
    assert title is not None
    assert unescape(title[1]).split(" | ") == [
        "bad & gone,drive_07,drive_9,drive_10", "drive_10,drive_9,drive_07,bad & gone",
        "drive_9,drive_07", "drive_10",
    ]  # fmt: skip


@pytest.mark.parametrize("light", [False, True])
def test_it_is_light_or_dark(page: Path, browse: Browse, tmp_path: Path, light: bool) -> None:
    picture = tmp_path / "page.png"
    browse(page.as_uri(), f"--screenshot={picture}", "--window-size=1250,1600", light=light)
    pixels = np.asarray(Image.open(picture).convert("RGB"), dtype=float)
    assert pixels.shape[:2] == (1600, 1250)
    background = np.median(pixels)
    assert background > 230 if light else background < 40
    assert (np.abs(pixels.mean(axis=2) - background) > 60).mean() > 0.01  # text and lines stand out
