"""The pictures of an input selection say what it was decided on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from recordings import static

from stages.results import RESIDUAL_EDGES, Chosen, Diagnosis
from viz.colours import BLUE, VERMILLION
from viz.plane import HEIGHT
from viz.report import report
from viz.selection import FIELD, selection_tabs
from viz.selection_plot import write_selection_plot
from viz.timeline import write_selections, write_timeline

ONE = Chosen(
    name="f/y", output="y", criterion="pooled", proven=True, candidates=("u(t)", "u(t-1)", "y(t-1)"),
    correlation=((1.0, 0.0, 0.0, 0.5), (0.0, 1.0, 0.0, -1.0), (0.0, 0.0, 1.0, 0.0), (0.5, -1.0, 0.0, 1.0)),
    genes=((1, 2), (0,), ()), scores=(-30.0, -20.0, 5.0), history=(5.0, -20.0, -30.0),
    residual=tuple(np.full(len(RESIDUAL_EDGES) - 1, 0.125)), spectrum=(1.0, 2.0, 0.5, 0.5),
)  # fmt: skip


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[object]]:
    path = tmp_path_factory.mktemp("selection") / "s.rrd"
    write_selections([ONE], "x", path)
    return static(path)


def at(found: dict[str, list[object]], picture: str, component: str) -> list[object]:
    (value,) = (
        v for k, v in found.items() if f"/{picture} " in k.replace("/f\\/y", "") and k.endswith(component)
    )
    return value


def test_the_map_is_blue_below_and_vermillion_above_zero(found: dict[str, list[object]]) -> None:
    (buffer,) = at(found, "correlation/fields", "Image:buffer")
    fields = np.array(buffer, dtype=np.uint8).reshape(4 * FIELD, 4 * FIELD, 3)
    middle = fields[FIELD // 2 :: FIELD, FIELD // 2 :: FIELD]
    assert tuple(middle[0, 0]) == VERMILLION
    assert tuple(middle[1, 3]) == BLUE
    assert tuple(middle[0, 1]) == (34, 37, 41)


def test_every_gene_is_named_and_lower_is_better(found: dict[str, list[object]]) -> None:
    assert at(found, "landscape/genes", "Points2D:labels") == ["u(t-1), y(t-1)", "u(t)", "nothing"]
    y = [p[1] for p in at(found, "landscape/genes", "Points2D:positions")]  # type: ignore[index]
    assert y[0] > y[1] > y[2]  # pictures count downwards
    assert min(y) >= -HEIGHT


def test_lines_have_what_they_should(found: dict[str, list[object]]) -> None:
    (course,) = at(found, "course/line", "LineStrips2D:strips")
    assert len({round(p[1], 3) for p in course}) == 3  # type: ignore[attr-defined]
    (spectrum,) = at(found, "spectrum/line", "LineStrips2D:strips")
    heights = [-p[1] for p in spectrum]  # type: ignore[attr-defined]
    assert np.argmax(heights) == 1
    assert heights[2] == pytest.approx(heights[3])


def test_a_run_has_the_tab_and_a_report_the_plot(diagnosis: Diagnosis, tmp_path: Path) -> None:
    assert diagnosis.about is not None
    with_one = replace(diagnosis, about=replace(diagnosis.about, selections=(ONE,)))
    write_timeline(with_one, tmp_path / "t.rrd")
    assert any("landscape/genes" in k for k in static(tmp_path / "t.rrd"))
    assert [tab.name for tab in selection_tabs((ONE,))] == ["Selection"]
    assert selection_tabs(()) == []
    fleet = pl.DataFrame({"vehicle": [None]})
    page = report("out", [], [], fleet, (), (ONE,))
    assert "What the inputs were selected on" in page
    assert "<h3>f/y: u(t-1), y(t-1)</h3>" in page
    assert "selected on" not in report("out", [], [], fleet)


def test_a_plot_of_its_own(tmp_path: Path) -> None:
    write_selection_plot(ONE, tmp_path / "one.svg")
    text = (tmp_path / "one.svg").read_text()
    assert "Correlation of the candidates" in text
    assert "of the best 3 genes" in text


def test_of_many_candidates_the_selected_ones_are_named(tmp_path: Path) -> None:
    count = 20
    many = replace(
        ONE, candidates=tuple(f"u(t-{i})" for i in range(count)), genes=((1, 2),), scores=(-30.0,),
        correlation=tuple(map(tuple, np.eye(count + 1).tolist())),
    )  # fmt: skip
    write_selections([many], "x", tmp_path / "s.rrd")
    told = [v for k, v in static(tmp_path / "s.rrd").items() if "/names/" in k and k.endswith(":labels")]
    assert told == [["u(t-1)", "u(t-2)", "y"]]
