"""Matplotlib figures as SVG that lies inside a page and takes the page's light or dark colours."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from viz import colours
from viz.colours import Colour, hex_of, on_paper

INK, FAINT = "#0a0b0c", "#0a0b0d"
"""Colours of text and of grid lines in a figure, which the page replaces by its own."""
STYLE: Any = {
    "svg.fonttype": "none", "svg.hashsalt": "dynoscope", "font.family": "sans-serif", "font.size": 9.0,
    "axes.facecolor": "none", "figure.facecolor": "none", "savefig.facecolor": "none",
    "axes.edgecolor": FAINT, "axes.labelcolor": INK, "axes.xmargin": 0.0, "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK, "grid.color": FAINT, "grid.linewidth": 0.6, "axes.grid": True,
    "axes.axisbelow": True, "axes.spines.top": False, "axes.spines.right": False,
    "lines.linewidth": 1.0, "xtick.labelsize": 8.0, "ytick.labelsize": 8.0,
    "path.simplify": True, "path.simplify_threshold": 0.3, "legend.frameon": False, "axes.titlesize": 9.0,
    "axes.titlelocation": "left", "axes.titleweight": "bold", "axes.titley": 1.0,
    "legend.fontsize": 8.0, "figure.dpi": 72.0,
}  # fmt: skip


@contextmanager
def style() -> Iterator[None]:
    """Figures made inside look as the report's do."""
    import matplotlib

    with matplotlib.rc_context(STYLE):
        yield


def themed(figure: Any) -> str:
    """The figure as an ``<svg>`` element whose colours are variables of :func:`variables`."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    text = io.StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    canvas: Any = FigureCanvasSVG(figure)
    canvas.print_svg(text, metadata=nothing)
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*" height="[^"]*"', r"\1", _one_line(svg), count=1)
    svg = re.sub(r'<g id="[a-zA-Z]+[\w.]*_\d+"', "<g", svg)  # ids would be there once a figure
    svg = re.sub(r' d="[^"]*"', lambda found: _short(found[0]), svg)
    svg = re.sub(r" font-family: [^;\"]*;", "", svg)  # the page's
    svg = re.sub(r"; stroke-linecap: square|; stroke-linejoin: miter", "", svg)
    return re.sub(r"#[0-9a-f]{6}", lambda found: _variable(found[0]), svg).replace("> <", "><")


def _one_line(svg: str) -> str:
    return re.sub(r"\s*\n\s*", " ", svg)


def _short(path: str) -> str:
    """A path's coordinates to a tenth of a point."""
    path = re.sub(r"(\d+\.\d)\d+", r"\1", path)
    return re.sub(r" ?([LMCz]) ?", r"\1", path)


def _variable(text: str) -> str:
    return f"var(--{text[1:]})" if text in (INK, FAINT) or text in _replaced() else text


def _replaced() -> dict[str, Colour]:
    return {hex_of(c): c for c in colours.EVERY}


def variables() -> tuple[str, str]:
    """Declarations of every colour's CSS variable on a dark and on a light page."""
    dark = {name: name for name in _replaced()} | {INK: "#d8dadd", FAINT: "#3a3f44"}
    light = {name: hex_of(on_paper(c)) for name, c in _replaced().items()} | {INK: "#222", FAINT: "#d5d8dc"}
    return _declared(dark), _declared(light)


def _declared(values: dict[str, str]) -> str:
    return "".join(f"--{name[1:]}:{value};" for name, value in values.items())
