"""Detectors: a recipe with all it has learned, as arrays (``.npz``) and a plain record (``.json``)."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ingest.errors import RecipeError, StoreError
from ingest.log import Log
from pipeline.digest import arrays_sha256
from pipeline.files import write_aside
from pipeline.recipe import Recipe, build_recipe
from pipeline.records import FORMAT, key_of, new_record, seal
from pipeline.template import bound, with_signals
from stages.stage import Arrays, Learner, Stage, connected

SUMS = ".sums"  # after the key, in the name of their file
# what numpy's reader raises on damaged files, besides its own ValueError
DAMAGE = (OSError, ValueError, EOFError, KeyError, RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error)


@dataclass(frozen=True, kw_only=True, eq=False)
class Detector:
    """A fitted recipe: ``stages`` hold what they learned, ``record`` says from what.

    The key depends on the recipe, the versions of its stages, the logs it learned from and what was learned.
    """

    recipe: Recipe
    stages: tuple[Stage, ...]
    record: Mapping[str, Any]
    sums: Arrays = field(default_factory=dict)  # what training can be continued from (stages.continuing)

    @property
    def key(self) -> str:
        return str(self.record["key"])

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything learned, named ``<place>.<stage>/<array>``."""
        return {
            f"{i}.{use}/{name}": array
            for i, (use, stage) in enumerate(zip(self.recipe.uses, self.stages, strict=True))
            if isinstance(stage, Learner)
            for name, array in stage.learned.items()
        }


def new_detector(
    recipe: Recipe,
    stages: Sequence[Stage],
    training: Sequence[Log] | Sequence[Mapping[str, Any]],
    calibration: Sequence[Log] | Sequence[Mapping[str, Any]],
    notes: Sequence[str],
    origin: Mapping[str, Any] | None = None,
    sums: Arrays | None = None,
) -> Detector:
    """A detector from fitted stages, with its record and key; ``origin``: how it came about, if not by a
    fit alone."""
    draft = Detector(recipe=recipe, stages=tuple(connected(stages)), record={}, sums=sums or {})
    return replace(draft, record=new_record(draft, training, calibration, notes, origin or {}))


def unfitted_detector(recipe: Recipe) -> Detector:
    """A detector of a recipe that works without having learned: its reference is each log's own start.

    Raises:
        StoreError: a stage must learn first.
    """
    must = [
        use
        for use, stage in zip(recipe.uses, recipe.stages, strict=True)
        if isinstance(stage, Learner) and not getattr(stage, "starts_unfitted", False)
    ]
    if must:
        raise StoreError(
            f"recipe {recipe.name!r} learns from fault-free logs ({', '.join(must)}); `dynoscope fit` them, "
            "and name the store of the detector with --store"
        )
    return new_detector(recipe, recipe.stages, [], [], ["nothing learned: the reference is each log's start"])


def save_detector(detector: Detector, folder: Path) -> None:
    """Write ``<key>.npz``, ``<key>.sums.npz`` if there are any, and ``<key>.json``; the record comes last,
    so a detector is whole once it is seen."""
    for suffix, arrays in (("", detector.arrays), (SUMS, detector.sums)):
        if arrays or not suffix:
            buffer = io.BytesIO()
            np.savez_compressed(buffer, allow_pickle=False, **arrays)
            write_aside(folder / f"{detector.key}{suffix}.npz", buffer.getvalue())
    write_aside(folder / f"{detector.key}.json", (json.dumps(detector.record, indent=1) + "\n").encode())


def load_record(path: Path) -> dict[str, Any]:
    """A detector's record, checked against its key.

    Raises:
        StoreError: it cannot be read, is of another format, or was changed.
    """
    try:
        record = dict(json.loads(path.read_text(encoding="utf-8")))
        made = record.get("format")
        intact = made == FORMAT and record["key"] == key_of(record) == path.stem
        intact = intact and record["seal"] == seal(record)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise StoreError(f"detector record {path} cannot be read: {error}; fit the detector again") from None
    if made != FORMAT:
        newer = isinstance(made, int) and made > FORMAT
        raise StoreError(
            f"detector {path.stem} has format {made!r}, this version of dynoscope reads {FORMAT}; "
            + ("take a newer version" if newer else f"fit the detector again on {_names(record)}")
        )
    if not intact:
        raise StoreError(f"detector record {path} was changed after it was written; fit the detector again")
    return record


def _names(record: Mapping[str, Any]) -> str:
    """The logs that a record of any format says it learned from."""
    logs = record.get("training")
    named = [str(log["log"]) for log in logs if "log" in log] if isinstance(logs, list) else []
    return ", ".join(named) or "its logs"


def load_detector(folder: Path, key: str) -> Detector:
    """The detector ``key`` of a store's folder, every part checked.

    Raises:
        StoreError: a file is missing, damaged or changed, or a stage has another version now.
    """
    record = load_record(folder / f"{key}.json")
    arrays = _load_arrays(folder / f"{key}.npz", record["arrays_sha256"])
    detector = restore(record, arrays)
    if "sums_sha256" not in record:
        return detector
    return replace(detector, sums=_load_arrays(folder / f"{key}{SUMS}.npz", record["sums_sha256"]))


def _load_arrays(path: Path, sha256: str) -> dict[str, NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except DAMAGE as error:
        raise StoreError(f"detector arrays {path} cannot be read: {error}; fit the detector again") from None
    if arrays_sha256(arrays) != sha256:
        raise StoreError(f"detector arrays {path} are not those of its record; fit the detector again")
    return arrays


def restore(record: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Detector:
    """A detector from its record and :attr:`Detector.arrays`.

    Raises:
        StoreError: this version does not take its recipe, or a stage has another version now.
    """
    key = record["key"]
    try:
        recipe = build_recipe(record["recipe"], record["definition"])
    except RecipeError as error:
        raise StoreError(
            f"detector {key} was fitted with a recipe this version does not take:\n{error}"
        ) from None
    if (now := recipe.versions()) != record["versions"]:
        changed = sorted(k for k in now if now[k] != record["versions"].get(k))
        raise StoreError(
            f"detector {key} was fitted with another version of {', '.join(changed)}; fit it again"
        )
    stages = tuple(
        replace(stage, learned=learned)  # type: ignore[type-var]
        if (learned := _learned(arrays, f"{i}.{use}/")) or isinstance(stage, Learner)
        else stage
        for i, (use, stage) in enumerate(zip(recipe.uses, recipe.stages, strict=True))
    )
    return Detector(recipe=recipe, stages=tuple(connected(stages)), record=record)


def check_recipe(detector: Detector, recipe: Recipe) -> None:
    """A detector brings its own recipe; ``recipe`` must not say anything else.

    Raises:
        StoreError: they differ; the message says where.
    """
    names = [*detector.recipe.outputs, *detector.recipe.inputs]
    old, new = detector.recipe.to_json(), recipe.to_json()
    if recipe.template and detector.recipe.outputs:  # the detector says which signals
        new = bound(with_signals(recipe, detector.recipe.outputs, detector.recipe.inputs), names).to_json()
    if old == new:
        return
    where = [k for k in old if k != "stage" and old[k] != new[k]]
    if detector.recipe.uses == recipe.uses:
        pairs = zip(recipe.uses, old["stage"], new["stage"], strict=True)
        where += [f"{use}.{k}" for use, a, b in pairs for k in a if a[k] != b[k]]
    else:
        where += [f"stages {', '.join(detector.recipe.uses)}"]
    raise StoreError(
        f"detector {detector.key} was fitted with another recipe {recipe.name!r} ({'; '.join(where)}); "
        "fit it again, or take the recipe as it was"
    )


def _learned(arrays: Mapping[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
