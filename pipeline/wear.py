"""What ``dynoscope adapt --out OUT`` leaves in the folder of a batch: its vehicles' wear from log to log."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ingest.errors import LogError
from pipeline.files import write_aside
from pipeline.summary import SUMMARY
from stages.witness import LIMIT

if TYPE_CHECKING:
    from viz.wear import Worn

WEAR = "wear.json"
NO_VEHICLE = "no vehicle"


def check_batch(out: Path) -> None:
    """Raises:
    LogError: ``out`` is not the folder of a batch, or what is there of wear is damaged."""
    if not (out / f"{SUMMARY}.parquet").is_file():
        raise LogError(
            f"--out {out} is not the folder of a batch; expected what `dynoscope run LOG... --out OUT` has "
            "written"
        )
    _kept(out)


def keep_wear(out: Path, report: Mapping[str, Any]) -> Path:
    """Put a report of :func:`pipeline.adapting.adapt` beside those of the batch's other vehicles; it takes
    the place of an earlier one of its vehicle.

    Raises:
        LogError: what is there is damaged, or cannot be written.
    """
    kept = {**_kept(out), report["vehicle"] or NO_VEHICLE: report}
    path = out / WEAR
    try:
        write_aside(path, (json.dumps(kept, indent=1) + "\n").encode())
    except OSError as error:
        raise LogError(f"cannot write {path}: {error.strerror or error}") from None
    return path


def _kept(out: Path) -> dict[str, Any]:
    path = out / WEAR
    if not path.is_file():
        return {}
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise _damaged(path, error) from None


def _damaged(path: Path, error: Exception) -> LogError:
    return LogError(
        f"{path} cannot be read ({error}); remove it, and make it again with `dynoscope adapt --out`"
    )


def wear_of_batch(out: Path) -> tuple[Worn, ...]:
    """What is kept of the batch's vehicles, to be drawn.

    Raises:
        LogError: it is damaged.
    """
    try:
        return tuple(_worn(vehicle, report) for vehicle, report in _kept(out).items())
    except (KeyError, TypeError, AttributeError) as error:
        raise _damaged(out / WEAR, error) from None


def _worn(vehicle: str, report: Mapping[str, Any]) -> Worn:
    from viz.wear import Kind, Worn

    drives = report["drives"]

    def over(name: str, what: str) -> Any:
        return np.array([d["wear"][name][what] for d in drives], dtype=float)

    kinds = tuple(
        Kind(
            name=name, unit=budget["unit"], value=over(name, "value"), sd=over(name, "sd"),
            growth=budget["per_100_drives"] / 100, total=budget["total"],
        )
        for name, budget in report["budgets"].items()
    )  # fmt: skip
    return Worn(
        vehicle=vehicle, reference=report["commissioning"], logs=tuple(d["log"] for d in drives), kinds=kinds,
        evidence=np.array([d["T"] for d in drives], dtype=float), threshold=report["threshold"],
        state=tuple(state_of(d) for d in drives), faults=tuple(faults_of(d) for d in drives),
        denied=denied(drives[-1]),
    )  # fmt: skip


def denied(drive: Mapping[str, Any]) -> float | None:
    """By how many standard deviations the recipe's witness denies the wear after a log, if it does."""
    z = drive["denial"]
    return z if z is not None and z > LIMIT else None


def state_of(drive: Mapping[str, Any]) -> str:
    """What came of a log, in the words of :data:`viz.wear.STATES`."""
    return "alarm" if drive["alarm"] else "learned from" if drive["learned"] else "learning rests"


def faults_of(drive: Mapping[str, Any]) -> str:
    """The faults that a log may show, with their sizes."""
    return ", ".join(f"{fault} {size:+.2g}" for fault, size in drive["faults"].items())
