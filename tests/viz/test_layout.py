from __future__ import annotations

from typing import Any

import pytest
import rerun.blueprint as rrb

from viz.colours import BLUE
from viz.layout import PANELS_PER_PAGE, overview_panels, signal_tabs
from viz.send import Line
from viz.signals import LogContents, Panel
from viz.views import LANE, heights


def panel(*names: str) -> Panel:
    lines = tuple(Line(entity="/e", field=name, name=name, colour=BLUE) for name in names)
    return Panel(title="t", lines=lines, range=(0.0, 1.0))


def contents(count: int, lanes: int = 0) -> LogContents:
    panels = tuple(panel(f"s{i}") for i in range(count))
    return LogContents(panels=panels, lanes=tuple(f"/states/{i}" for i in range(lanes)), remarks=())


def test_key_signals_come_first_on_the_overview_each_panel_once() -> None:
    first, pressures, flow, speed = panel("T_Int"), panel("p_Int", "p_Bst"), panel("W_HFM"), panel("n_Eng")
    assert overview_panels([first, pressures, flow, speed], 2) == [speed, pressures]
    assert overview_panels([first, pressures], 3) == [pressures, first]


def tree(node: Any) -> Any:
    """Nested lists of names: of containers their kind and children, of views their kind alone."""
    kind = type(node).__name__
    return (kind, [tree(child) for child in node.contents]) if isinstance(node, rrb.Container) else kind


PLOT = "TimeSeriesView"


@pytest.mark.parametrize(
    ("count", "pages"),
    [(1, [1]), (12, [12]), (13, [6, 7]), (25, [8, 8, 9]), (100, [11, 11, 11, 11, 11, 11, 11, 11, 12])],
)
def test_signals_are_spread_evenly_over_pages(count: int, pages: list[int]) -> None:
    (tab,) = signal_tabs(contents(count))
    grids = [("Grid", [PLOT] * size) for size in pages]
    assert tree(tab) == (("Vertical", grids) if len(pages) == 1 else ("Tabs", grids))
    assert max(pages) <= PANELS_PER_PAGE


def test_text_stands_below_the_signals_or_on_a_page_of_its_own() -> None:
    (tab,) = signal_tabs(contents(3, lanes=2))
    assert tree(tab) == ("Vertical", [("Grid", [PLOT] * 3), "StateTimelineView"])
    (tab,) = signal_tabs(contents(3, lanes=30))
    assert tree(tab) == ("Tabs", [("Grid", [PLOT] * 3), ("Vertical", ["StateTimelineView"])])
    assert signal_tabs(contents(0)) == []


def test_lanes_get_the_height_they_need() -> None:
    shares = heights([2.0, 3.0], ["/a", "/b"])
    assert sum(shares) == pytest.approx(1.0)
    assert shares[2] > 2 * LANE
    assert shares[1] / shares[0] == pytest.approx(1.5)
    assert heights([1.0], []) == [1.0]
