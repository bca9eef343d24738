from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from ingest.maps import NameMap, SignalMap, TimeMap
from pipeline.digest import KEY_LENGTH, arrays_sha256, digest, file_sha256, map_digest, settings

SCALAR = (
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text()
)
JSON = st.recursive(SCALAR, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=8)


@given(st.dictionaries(st.text(), JSON, min_size=2))
def test_order_of_keys_does_not_matter(value: dict[str, Any]) -> None:
    assert digest(value) == digest(dict(reversed(list(value.items()))))


def test_digest_is_that_of_the_canonical_text() -> None:
    """The key is part of what is stored, so it must never change between versions."""
    text = '[{"a":1.5,"b":[true,null,"\\u00e9"]}]'
    assert (
        digest({"b": [True, None, "é"], "a": 1.5}) == hashlib.sha256(text.encode()).hexdigest()[:KEY_LENGTH]
    )


def test_order_of_parts_and_nesting_matter() -> None:
    assert len({digest("a", "b"), digest("b", "a"), digest(["a", "b"]), digest("ab")}) == 4


def test_what_json_cannot_say_is_refused() -> None:
    with pytest.raises(ValueError):
        digest({"x": math.nan})


def test_file_digest(tmp_path: Path) -> None:
    (tmp_path / "x").write_bytes(b"abc" * 100_000)
    assert file_sha256(tmp_path / "x") == hashlib.sha256(b"abc" * 100_000).hexdigest()


def test_map_digest_is_that_of_what_it_says(tmp_path: Path) -> None:
    one, other = tmp_path / "a.dbc", tmp_path / "b.dbc"
    one.write_text("x")
    other.write_text("x")
    names = NameMap(signals={"n_Eng": SignalMap(source=("rpm",))}, dbc=(one,))
    assert map_digest(None) is None
    assert map_digest(names) == map_digest(replace(names, dbc=(other,), origin="elsewhere"))
    other.write_text("y")
    changed = [
        replace(names, dbc=(other,)), replace(names, time=TimeMap(rate=10.0)), replace(names, signals={}),
    ]  # fmt: skip
    assert len({map_digest(m) for m in [names, *changed]}) == 4


@pytest.mark.parametrize(
    "changed",
    [
        {"a": np.array([1.0, 2.5]), "b": np.array([[1, 2]])},
        {"a": np.array([1.0, 2.0]), "c": np.array([[1, 2]])},
        {"a": np.array([1.0, 2.0]), "b": np.array([1, 2])},
        {"a": np.array([1.0, 2.0], dtype=np.float32), "b": np.array([[1, 2]])},
        {"a": np.array([1.0, 2.0])},
    ],
    ids=["value", "name", "shape", "type", "fewer"],
)
def test_arrays_digest_sees_every_change(changed: dict[str, NDArray[Any]]) -> None:
    arrays = {"a": np.array([1.0, 2.0]), "b": np.array([[1, 2]])}
    assert arrays_sha256(arrays) != arrays_sha256(changed)


def test_arrays_digest_sees_neither_order_nor_layout() -> None:
    x = np.arange(6.0).reshape(2, 3)
    assert arrays_sha256({"a": x, "b": x}) == arrays_sha256({"b": x, "a": np.asfortranarray(x)})


@dataclass(frozen=True)
class Inner:
    names: tuple[str, ...] = ("p", "q")


@dataclass(frozen=True)
class Outer:
    parts: dict[str, Inner] = field(default_factory=lambda: {"x": Inner()})
    learned: dict[str, float] = field(default_factory=lambda: {"secret": 1.0})


def test_settings_are_plain_and_without_what_was_learned() -> None:
    assert settings(Outer()) == {"parts": {"x": {"names": ["p", "q"]}}}
