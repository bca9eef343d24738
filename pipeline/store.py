"""The detector store: a folder of immutable detectors and, per recipe, a pointer to the champion."""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ingest.errors import StoreError, did_you_mean
from pipeline.detector import Detector, load_detector, load_record, save_detector
from pipeline.files import write_aside

CHAMPION = "champion"


@dataclass(frozen=True)
class Store:
    """A store in ``folder``: ``<key>.npz``, ``<key>.json`` and ``champions/<recipe>.json``, the pointer's
    history."""

    folder: Path

    def __post_init__(self) -> None:
        if self.folder.exists() and not self.folder.is_dir():
            raise StoreError(
                f"store {self.folder} is not a folder; give the folder in which detectors are kept"
            )

    def add(self, detector: Detector) -> bool:
        """Keep ``detector``; the first of a recipe becomes champion. Returns whether it is champion.

        Raises:
            StoreError: the folder cannot be written.
        """
        try:
            save_detector(detector, self.folder)
            if self._history(detector.recipe.name) == []:
                self.promote(detector.key, detector.recipe.name, "first of its recipe")
        except OSError as error:
            raise StoreError(f"store {self.folder} cannot be written: {error.strerror or error}") from None
        return self.champion(detector.recipe.name) == detector.key

    def promote(self, key: str, recipe: str, reason: str) -> None:
        """Make ``key`` the champion of ``recipe``; earlier ones stay in the history."""
        entry = {"key": key, "reason": reason, "since": datetime.now(UTC).isoformat(timespec="seconds")}
        text = json.dumps([*self._history(recipe), entry], indent=1) + "\n"
        write_aside(self._pointer(recipe), text.encode())

    def champion(self, recipe: str) -> str:
        """Key of the champion.

        Raises:
            StoreError: the recipe has none.
        """
        history = self._history(recipe)
        if not history:
            known = sorted({str(r["recipe"]) for r in self.records()})
            raise StoreError(
                f"store {self.folder} has no detector of recipe {recipe!r}, "
                f"but of: {', '.join(known) or 'none'}; "
                f"fit one: dynoscope fit LOG... --recipe {recipe} --store {self.folder}"
            )
        return str(history[-1]["key"])

    def get(self, recipe: str, key: str = CHAMPION) -> Detector:
        """A detector by key (or its unambiguous beginning), or the champion of ``recipe``.

        Raises:
            StoreError: there is none, it is damaged, or it is of another recipe.
        """
        full = self.champion(recipe) if key == CHAMPION else self.resolve(key)
        detector = load_detector(self.folder, full)
        if detector.recipe.name != recipe:
            raise StoreError(f"detector {full} is of recipe {detector.recipe.name!r}, not {recipe!r}")
        return detector

    def resolve(self, key: str) -> str:
        """The full key that begins with ``key``.

        Raises:
            StoreError: none or several do.
        """
        keys = sorted(p.stem for p in self._files())
        found = [k for k in keys if k.startswith(key)]
        if len(found) == 1 and key:
            return found[0]
        hint = f"several begin so: {', '.join(found)}" if found and key else did_you_mean(key, keys)
        raise StoreError(f"store {self.folder} has no detector {key!r}; {hint}")

    def records(self) -> list[dict[str, Any]]:
        """The records of all detectors, oldest first."""
        return sorted((load_record(p) for p in self._files()), key=lambda r: str(r["created"]))

    def _files(self) -> list[Path]:
        return [p for p in self.folder.glob("*.json") if not p.name.startswith(".")]  # no drafts

    def _pointer(self, recipe: str) -> Path:
        return self.folder / "champions" / f"{recipe}.json"

    def _history(self, recipe: str) -> list[dict[str, str]]:
        try:
            history = json.loads(self._pointer(recipe).read_text(encoding="utf-8"))
            if not history or any(not isinstance(entry["key"], str) for entry in history):
                raise ValueError("it names no detector")
            return list(history)
        except FileNotFoundError:
            return []
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise StoreError(
                f"champion pointer {self._pointer(recipe)} cannot be read: {error}; "
                "delete it to begin anew, or name a detector with --detector"
            ) from None
