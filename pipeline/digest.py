"""Content keys: the same content has the same key on every machine, at every time."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ingest.maps import NameMap

KEY_LENGTH = 32
NOT_SETTINGS = ("learned", "before")  # what a stage was given, not told


def digest(*parts: Any) -> str:
    """Key of JSON values: sha256 of their canonical text, 32 hex digits.

    >>> digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1})
    True
    """
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_LENGTH]


def file_sha256(path: Path) -> str:
    """sha256 of a file's content, in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def arrays_sha256(arrays: Mapping[str, NDArray[Any]]) -> str:
    """sha256 over names, types, shapes and bytes of arrays, in order of name."""
    total = hashlib.sha256()
    for name in sorted(arrays):
        a = np.ascontiguousarray(arrays[name])
        total.update(f"{name}|{a.dtype.str}|{a.shape}|".encode())
        total.update(a.tobytes())
    return total.hexdigest()


def settings(stage: Any) -> dict[str, Any]:
    """A stage's settings as plain JSON values; what it has learned is not among them."""
    return {f.name: _plain(getattr(stage, f.name)) for f in fields(stage) if f.name not in NOT_SETTINGS}


def map_digest(names: NameMap | None) -> str | None:
    """Key of what a map says, and of the DBC files that it names; not of where they lie."""
    if names is None:
        return None
    said = {k: v for k, v in settings(replace(names, dbc=())).items() if k != "origin"}
    return digest(said, [file_sha256(path) if path.is_file() else None for path in names.dbc])


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return settings(value)
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(v) for v in value]
    return value
