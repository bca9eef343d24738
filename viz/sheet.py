"""A page of the static reports: one HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from importlib.resources import files
from string import Template

from viz.svg import variables


def sheet(title: str, parts: Iterable[str]) -> str:
    """``parts`` (HTML; empty ones are left out) as a page called ``title``."""
    place = files("viz").joinpath("page")
    page, style, script = (
        place.joinpath(name).read_text(encoding="utf-8") for name in ("page.html", "style.css", "table.js")
    )
    dark, light = variables()
    return Template(page).substitute(
        title=escape(title), body="\n".join(p for p in parts if p), script=script,
        style=Template(style).substitute(dark=dark, light=light),
    )  # fmt: skip
