"""MATLAB files: version 5 by ``scipy``, version 7.3 (and plain HDF5) by ``h5py``.

Vectors of one length that lie in the same place are a table with the time vector among them; a struct is a
place of its own, and so is each field of a struct of structs (``data.ecu.n``). A struct ``time`` +
``signals.values`` as Simulink saves it is one table.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.clock import time_column
from ingest.errors import LogError
from ingest.log import Log, Signal
from ingest.maps import NameMap
from ingest.readers import Recording, check_declared, need
from ingest.tables import Table, log_of_tables

GROUP = "data"
_HDF5 = b"\x89HDF\r\n\x1a\n"
_WIDEST = 64  # columns of a matrix that are taken as signals


def is_mine(path: Path, head: bytes) -> bool:
    """Whether the file begins as a MATLAB or HDF5 file."""
    return head.startswith((b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file", _HDF5))


def header(path: Path, names: NameMap) -> Recording:
    """Channels; version 5 has to be read for that."""
    found = read(path, names)
    groups = {k: type(g)(k, g.frame.clear(), g.signals) for k, g in found.log.groups.items()}
    rows = {k: g.frame.height for k, g in found.log.groups.items()}
    return Recording(Log(found.log.name, groups, (), {**found.log.facts, "rows": rows}))


def read(path: Path, names: NameMap) -> Recording:
    """Every numeric vector that has a time vector beside it.

    Raises:
        LogError: damaged, no time vector, or no samples.
    """
    with path.open("rb") as file:
        new = _HDF5 in file.read(1024)
    variables = _load_7_3(path) if new else _load_5(path)
    tables: dict[str, Table] = {}
    notes: list[str] = []
    for place, members in _places(variables, "", notes):
        tables |= _tables(place, members, names, notes)
    if not tables:
        raise LogError(f"{path}: no samples: no numeric vector in {', '.join(variables) or 'an empty file'}")
    log = log_of_tables(str(path), path.stem, tables, names.time)
    if not any(g.frame.height for g in log.groups.values()):
        raise LogError(f"{path}: no samples: no row has a time")
    facts = {**log.facts, **({"notes": [*notes, *log.facts.get("notes", ())]} if notes else {})}
    return Recording(Log(log.name, log.groups, (), facts))


def _load_5(path: Path) -> dict[str, Any]:
    from scipy.io import loadmat

    try:
        found = loadmat(path, simplify_cells=True)
    except Exception as error:  # on damage the library raises whatever its parser stumbles over
        raise LogError(f"{path}: damaged MATLAB file: {error or type(error).__name__}") from error
    return {k: v for k, v in found.items() if not k.startswith("__")}


def _load_7_3(path: Path) -> dict[str, Any]:
    h5py = need("h5py", "mat")

    def load(item: Any) -> Any:
        if isinstance(item, h5py.Group):
            return {k: load(v) for k, v in item.items() if not k.startswith("#")}
        if getattr(item, "shape", None) is None:
            return None
        check_declared(path, math.prod(item.shape), 1)
        if item.attrs.get("MATLAB_class") == b"char":
            return "".join(map(chr, np.asarray(item[()]).ravel(order="F")))
        values = np.asarray(item[()])
        return values.T if values.dtype.kind in "biuf" else None  # MATLAB counts columns first

    try:
        with h5py.File(path, "r") as file:
            found = load(file)
    except (OSError, ValueError, KeyError, RuntimeError, TypeError) as error:
        raise LogError(f"{path}: damaged MATLAB 7.3 file: {error}") from error
    return dict(found)


def _places(
    variables: Mapping[str, Any], place: str, notes: list[str]
) -> Iterator[tuple[str, dict[str, NDArray[Any]]]]:
    """Each struct, and the top, with its vectors; matrices column by column."""
    here: dict[str, NDArray[Any]] = {}
    for name, value in variables.items():
        if isinstance(value, Mapping):
            inner = dict(value)
            if "time" in variables and "values" in inner:  # Simulink's structure with time
                here |= _columns(str(inner.get("label") or name), np.asarray(inner["values"]))
            else:
                yield from _places(inner, f"{place}.{name}" if place else name, notes)
        elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf" and value.size > 1:
            here |= _columns(name, value)
        elif not isinstance(value, str | int | float | np.ndarray):
            notes.append(f"variable {name!r} was skipped: it holds no numbers")
    if here:
        yield place or GROUP, here


def _columns(name: str, values: NDArray[Any]) -> dict[str, NDArray[Any]]:
    if values.ndim == 2 and 1 in values.shape:
        values = values.ravel()
    if values.ndim == 1:
        return {name: values}
    if values.ndim == 2 and values.shape[1] <= _WIDEST:
        return {f"{name}[{i}]": values[:, i] for i in range(values.shape[1])}
    return {name: values}


def _tables(
    place: str, members: dict[str, NDArray[Any]], names: NameMap, notes: list[str]
) -> dict[str, Table]:
    """One table per length that has a time vector; the rest is told."""
    lengths: dict[int, dict[str, NDArray[Any]]] = {}
    for name, values in members.items():
        if values.ndim == 1:
            lengths.setdefault(len(values), {})[name] = values
        else:
            notes.append(f"variable {name!r} was skipped: {values.shape} values")
    timed = {n: m for n, m in lengths.items() if time_column(m, names.time) is not None}
    left = [name for n, m in lengths.items() if n not in timed for name in m]
    if timed and left:
        notes.append(f"without a time vector of their length: {', '.join(left[:10])}")
    found = {}
    for i, columns in enumerate((timed or lengths).values(), 1):
        frame = pl.DataFrame({n: pl.Series(np.ascontiguousarray(v)) for n, v in columns.items()})
        found[place if i == 1 else f"{place}_{i}"] = Table(frame, {n: Signal(name=n) for n in columns})
    return found
