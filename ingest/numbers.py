"""Cells of a text table as numbers, where the parser did not take them at first."""

from __future__ import annotations

import polars as pl

MISSING = (
    "", "nan", "-nan", "+nan", "nan(ind)", "-nan(ind)", "na", "n/a", "null", "none", "nil", "-", "--", "---",
    "*", "?", "#n/a", "#nv", "#null!", "#div/0!", "#value!", "#ref!", "1.#qnan", "-1.#qnan", "1.#ind",
    "-1.#ind", "1.#inf", "-1.#inf", "invalid", "no value", "novalue",
)  # fmt: skip
"""Cells that say "no value", in any case."""
_SPACED = r"^([+-]?\d{1,3})((?:[ '’\u00a0\u202f]\d{3})+)((?:[.,]\d*)?)$"
_GROUPS = r"^[+-]?\d{1,3}(?:%s\d{3})+(?:%s\d*)?$"
_SURE = r"(?:%s\d{3}){2}|%s\d{3}%s"  # grouped in thousands without doubt


def strip(cells: pl.Series) -> pl.Series:
    """Cells without space around them; null where they say "no value"."""
    text = cells.str.strip_chars()
    return text.set(text.str.to_lowercase().is_in(MISSING), None)


def numbers(cells: pl.Series, *, decimal_comma: bool) -> pl.Series:
    """Float64 of stripped cells, null where they are no number or could be two.

    Thousands may be set apart by spaces or apostrophes; by the sign that is not the decimal one only where a
    cell of the column leaves no doubt. ``1,234`` alone is neither 1.234 nor 1234.

    >>> numbers(pl.Series(["1 234,5", "2"]), decimal_comma=True).to_list()
    [1234.5, 2.0]
    >>> numbers(pl.Series(["1,234", "1,234.5"]), decimal_comma=False).to_list()
    [1234.0, 1234.5]
    >>> numbers(pl.Series(["1,234", "7"]), decimal_comma=False).to_list()
    [None, 7.0]
    """
    if cells.null_count() == len(cells):
        return cells.cast(pl.Float64, strict=False)
    decimal, other = (",", ".") if decimal_comma else (".", ",")
    point, group = f"\\{decimal}", f"\\{other}"
    spaced = cells.str.contains(_SPACED)
    text = cells.str.replace_all("[ '’\u00a0\u202f]", "").zip_with(spaced, cells) if spaced.any() else cells
    grouped = text.str.contains(_GROUPS % (group, point))
    doubtful = text.filter(grouped)
    if doubtful.str.contains(_SURE % (group, group, point)).any():
        text = text.str.replace_all(other, "", literal=True).zip_with(grouped, text)
    elif len(doubtful) and not text.filter(~grouped).str.contains(rf"\d{group}\d*$").any():
        text = text.set(grouped, None)
    return text.str.replace(decimal, ".", literal=True).cast(pl.Float64, strict=False)
