"""A detector's record: what it was made of and from, what it learned in numbers, and its seal.

The key is a digest of the content; the seal, of all the record, so that a note or a date cannot be changed
unseen either. It tells an accident or a careless edit, not a forger, who can compute it too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.log import Log
from pipeline.digest import arrays_sha256, digest, settings
from stages.detect import Detect
from stages.isolate import Isolate
from stages.narx import COMBINATIONS, Narx
from stages.relations import Relations
from stages.residuals import Residuals
from stages.select_inputs import SelectInputs
from stages.stage import Stage

if TYPE_CHECKING:
    from pipeline.detector import Detector

FORMAT = 2
BESIDE = ("key", "notes", "created", "packages", "seal")  # what the key does not depend on
DIGITS = 6  # of numbers that are there to be read


def new_record(
    draft: Detector,
    training: Sequence[Log] | Sequence[Mapping[str, Any]],
    calibration: Sequence[Log] | Sequence[Mapping[str, Any]],
    notes: Sequence[str],
    origin: Mapping[str, Any],
) -> dict[str, Any]:
    """The record of a detector that has none yet; ``training``, ``calibration``: logs, or what another
    record says of them; ``origin``: how it came about, if not by a fit alone."""
    from pipeline.manifest import packages

    recipe = draft.recipe
    content: dict[str, Any] = {
        "format": FORMAT,
        "recipe": recipe.name,
        "definition": recipe.to_json(),
        "versions": recipe.versions(),
        "training": [source(log) if isinstance(log, Log) else dict(log) for log in training],
        "calibration": [source(log) if isinstance(log, Log) else dict(log) for log in calibration],
        "seeds": _seeds(draft.stages),
        "arrays_sha256": arrays_sha256(draft.arrays),
        "scores": _scores(draft.stages),
        "thresholds": _thresholds(draft.stages),
    }
    optional = {"selected": _selected(draft.stages), "held_out_rms": _compared(draft.stages), **origin,
                "sums_sha256": draft.sums and arrays_sha256(draft.sums)}  # fmt: skip
    content |= {k: v for k, v in optional.items() if v}
    record = {
        "key": digest(content), **content, "notes": list(notes), "packages": packages(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }  # fmt: skip
    return {**record, "seal": seal(record)}


def seal(record: Mapping[str, Any]) -> str:
    """Digest of a record without its seal."""
    return digest({k: v for k, v in record.items() if k != "seal"})


def key_of(record: Mapping[str, Any]) -> str:
    """The key that belongs to a record's content."""
    return digest({k: v for k, v in record.items() if k not in BESIDE})


def source(log: Log) -> dict[str, Any]:
    """Which log, and what part of it: its name, its file with the sha256, or the sha256 of its values where
    it comes from no file, and its span in s."""
    start, end = log.span
    known = {k: log.facts[k] for k in ("file", "sha256", "seed") if k in log.facts}
    known.setdefault("sha256", _content_sha256(log))
    return {"log": log.name, **known, "start_s": start, "end_s": end}


def _content_sha256(log: Log) -> str:
    """Of the names and values of all signals."""
    arrays: dict[str, NDArray[Any]] = {}
    for name, group in log.groups.items():
        for column, kind in group.frame.schema.items():
            numeric = kind.is_numeric() or kind == pl.Boolean
            series = group.frame[column]
            arrays[f"{name}/{column}"] = (
                series.cast(pl.Float64).fill_null(np.nan).to_numpy()
                if numeric
                else np.array([str(x) for x in series.to_list()], dtype="U")
            )
    return arrays_sha256(arrays)


def _seeds(stages: Sequence[Stage]) -> dict[str, int]:
    """Every seed among the settings, by the place of its stage and its name."""
    return {
        f"{i}.{path}": value for i, stage in enumerate(stages) for path, value in _seeds_in(settings(stage))
    }


def _seeds_in(values: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, int]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _seeds_in(value, f"{before}{name}.")
        elif name == "seed":
            yield before + name, int(value)


def _scores(stages: Sequence[Stage]) -> dict[str, dict[str, float]]:
    """``rms`` of each relation in training and ``sigma`` of each residual in calibration, over all
    regimes."""
    scores: dict[str, dict[str, float]] = {}
    for stage in stages:
        if isinstance(stage, Relations) and stage.learned:
            studies = {n: x for n in stage.relations if (x := stage.learned.get(f"{n}/study")) is not None}
            if studies:
                scores["map_nodes"] = {n: float(x[x[:, -1] == 1][0, 0]) for n, x in studies.items()}
            scores["rms"] = {name: _short(model.rms) for name, model in stage.models.items()}
        if isinstance(stage, Residuals) and stage.learned:
            overall = stage.learned["sigma"][:, -1]
            scores["sigma"] = {r: _short(x) for r, x in zip(stage.residuals, overall, strict=True)}
    return scores


def _thresholds(stages: Sequence[Stage]) -> dict[str, dict[str, float]]:
    """Alarm thresholds by memory, and within it by fault, or by residual where none is supposed."""
    residuals: list[str] = []
    for stage in stages:
        if isinstance(stage, Residuals):
            residuals = [*stage.residuals]
        if not isinstance(stage, Isolate | Detect) or "threshold" not in stage.learned:
            continue
        of = list(stage.hypotheses) if isinstance(stage, Isolate) else residuals
        memories = [f"{s:g} s" for s in stage.memories_s]
        memories += ["step", "offsets known"] * isinstance(stage, Isolate)
        rows = zip(memories, stage.learned["threshold"], strict=True)
        return {m: {n: _short(x) for n, x in zip(of, row, strict=False)} for m, row in rows}
    return {}


def _short(x: Any) -> float:
    return float(f"{float(x):.{DIGITS}g}")


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
