"""Detectors: a recipe with all it has learned, as arrays (``.npz``) and a plain record (``.json``)."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ingest.errors import RecipeError, StoreError
from ingest.log import Log
from pipeline.digest import arrays_sha256, digest
from pipeline.files import write_aside
from pipeline.recipe import Recipe, build_recipe
from pipeline.template import bound, with_signals
from stages.narx import COMBINATIONS, Narx
from stages.select_inputs import SelectInputs
from stages.stage import Learner, Stage, connected

FORMAT = 1
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
    training: Sequence[Log],
    calibration: Sequence[Log],
    notes: Sequence[str],
) -> Detector:
    """A detector from fitted stages, with its record and key."""
    draft = Detector(recipe=recipe, stages=tuple(connected(stages)), record={})
    content: dict[str, Any] = {
        "format": FORMAT,
        "recipe": recipe.name,
        "definition": recipe.to_json(),
        "versions": recipe.versions(),
        "training": [_source(log) for log in training],
        "calibration": [_source(log) for log in calibration],
        "arrays_sha256": arrays_sha256(draft.arrays),
    }
    if selected := _selected(draft.stages):
        content["selected"] = selected
    if compared := _compared(draft.stages):
        content["held_out_rms"] = compared
    created = datetime.now(UTC).isoformat(timespec="seconds")
    return replace(
        draft, record={"key": digest(content), **content, "notes": list(notes), "created": created}
    )


def _selected(stages: Sequence[Stage]) -> dict[str, list[str]]:
    """The regressors that were selected, by relation."""
    learned = [stage for stage in stages if isinstance(stage, SelectInputs) and stage.learned]
    return {name: list(stage.chosen(name)) for stage in learned for name in stage.targets}


def _compared(stages: Sequence[Stage]) -> dict[str, dict[str, float]]:
    """What each combination of local models leaves on held-out rows, by model."""
    learned = [stage for stage in stages if isinstance(stage, Narx) and stage.learned]
    return {
        name: dict(zip(COMBINATIONS, stage.learned[f"{name}/held_out"].tolist(), strict=True))
        for stage in learned
        for name in stage.models
    }


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
    """Write ``<key>.npz`` and ``<key>.json``; the record comes last, so a detector is whole once it is
    seen."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **detector.arrays)
    write_aside(folder / f"{detector.key}.npz", buffer.getvalue())
    write_aside(folder / f"{detector.key}.json", (json.dumps(detector.record, indent=1) + "\n").encode())


def load_record(path: Path) -> dict[str, Any]:
    """A detector's record, checked against its key.

    Raises:
        StoreError: it cannot be read, is of another format, or was changed.
    """
    try:
        record = dict(json.loads(path.read_text(encoding="utf-8")))
        content = {k: v for k, v in record.items() if k not in ("key", "notes", "created")}
        intact = record["key"] == digest(content) == path.stem
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise StoreError(f"detector record {path} cannot be read: {error}; fit the detector again") from None
    if record.get("format") != FORMAT:
        raise StoreError(
            f"detector {path.stem} has format {record.get('format')!r}, this version reads {FORMAT}; "
            "fit the detector again"
        )
    if not intact:
        raise StoreError(f"detector record {path} was changed after it was written; fit the detector again")
    return record


def load_detector(folder: Path, key: str) -> Detector:
    """The detector ``key`` of a store's folder, every part checked.

    Raises:
        StoreError: a file is missing, damaged or changed, or a stage has another version now.
    """
    record = load_record(folder / f"{key}.json")
    path = folder / f"{key}.npz"
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except DAMAGE as error:
        raise StoreError(f"detector arrays {path} cannot be read: {error}; fit the detector again") from None
    if arrays_sha256(arrays) != record["arrays_sha256"]:
        raise StoreError(f"detector arrays {path} are not those of its record; fit the detector again")
    return restore(record, arrays)


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


def _source(log: Log) -> dict[str, Any]:
    start, end = log.span
    known = {k: log.facts[k] for k in ("file", "sha256") if k in log.facts}
    return {"log": log.name, **known, "start_s": start, "end_s": end}
