"""The detector store: a folder of immutable detectors and, per recipe, a pointer to the champion."""

from __future__ import annotations

import fcntl
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
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
        self.keep(detector)
        with self._writing(), self._locked():
            if self.history(detector.recipe.name) == []:
                self._note(detector.recipe.name, {"key": detector.key, "reason": "first of its recipe"})
        return self.champion(detector.recipe.name) == detector.key

    def keep(self, detector: Detector) -> None:
        """Keep ``detector``, which does not become champion.

        Raises:
            StoreError: the folder cannot be written.
        """
        with self._writing():
            save_detector(detector, self.folder)

    def promote(self, key: str, recipe: str, reason: str) -> None:
        """Make ``key`` the champion of ``recipe``; earlier ones stay in the history.

        Raises:
            StoreError: the folder cannot be written.
        """
        with self._writing(), self._locked():
            self._note(recipe, {"key": key, "reason": reason})

    def keep_comparison(self, comparison: Mapping[str, Any]) -> None:
        """Keep what a challenger was compared to the champion with, as JSON values.

        Raises:
            StoreError: the folder cannot be written.
        """
        path = self._comparison(comparison["champion"], comparison["challenger"])
        with self._writing():
            write_aside(path, (json.dumps(comparison, indent=1) + "\n").encode())

    def comparison(self, champion: str, challenger: str) -> dict[str, Any] | None:
        """The comparison of two detectors that was kept, None where there was none.

        Raises:
            StoreError: it cannot be read.
        """
        path = self._comparison(champion, challenger)
        try:
            found = dict(json.loads(path.read_text(encoding="utf-8")))
            assert {*found} >= {"champion", "challenger", "rows", "verdict"}
            return found
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError, AssertionError) as error:
            raise StoreError(f"comparison {path} cannot be read: {error}; compare again") from None

    def rollback(self, recipe: str, reason: str) -> str:
        """Make the champion before the present one champion again, and return its key; doing it again goes
        further back.

        Raises:
            StoreError: there was none before, or the folder cannot be written.
        """
        with self._writing(), self._locked():
            stack = _standing(self.history(recipe))
            if len(stack) < 2:
                raise StoreError(
                    f"recipe {recipe!r} of store {self.folder} has had no champion before this one"
                )
            self._note(recipe, {"key": stack[-2], "reason": reason, "back": "yes"})
            return stack[-2]

    def champion(self, recipe: str) -> str:
        """Key of the champion.

        Raises:
            StoreError: the recipe has none.
        """
        history = self.history(recipe)
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

    def load(self, key: str) -> Detector:
        """The detector with this full key.

        Raises:
            StoreError: it is damaged, or of another version.
        """
        return load_detector(self.folder, key)

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

    def survey(self) -> list[dict[str, Any]]:
        """What is in the store, oldest first: ``key recipe champion created training calibration``, and
        ``problem`` of a detector that cannot be used."""
        found = []
        for path in self._files():
            entry: dict[str, Any] = {"key": path.stem, "recipe": None, "champion": False, "created": None}
            try:
                record = load_record(path)
                entry |= {k: record[k] for k in ("recipe", "created")}
                history = self.history(record["recipe"])
                entry["champion"] = bool(history) and history[-1]["key"] == path.stem
                entry |= {k: [log["log"] for log in record[k]] for k in ("training", "calibration")}
                load_detector(self.folder, path.stem)
                entry["problem"] = None
            except StoreError as error:
                entry["problem"] = str(error)
            found.append(entry)
        return sorted(found, key=lambda e: (str(e["created"]), e["key"]))

    def _files(self) -> list[Path]:
        return [p for p in self.folder.glob("*.json") if not p.name.startswith(".")]  # no drafts

    def _note(self, recipe: str, entry: dict[str, str]) -> None:
        """Adds to a recipe's history; to be called while the store is locked."""
        entry["since"] = datetime.now(UTC).isoformat(timespec="seconds")
        text = json.dumps([*self.history(recipe), entry], indent=1) + "\n"
        write_aside(self._pointer(recipe), text.encode())

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """One writer of pointers at a time, in whatever process; a lock goes with the process that has it."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / ".lock").open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise StoreError(f"store {self.folder} cannot be written: {error.strerror or error}") from None

    def _comparison(self, champion: str, challenger: str) -> Path:
        return self.folder / "comparisons" / f"{champion}.{challenger}.json"

    def _pointer(self, recipe: str) -> Path:
        return self.folder / "champions" / f"{recipe}.json"

    def history(self, recipe: str) -> list[dict[str, str]]:
        """The champions of ``recipe``, the present one last; empty if it has none."""
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


def _standing(history: Sequence[Mapping[str, str]]) -> list[str]:
    """Keys of the champions that were not rolled back, the present one last.

    >>> _standing([{"key": "a"}, {"key": "b"}, {"key": "c"}, {"key": "b", "back": "yes"}])
    ['a', 'b']
    """
    stack: list[str] = []
    for entry in history:
        if "back" in entry:
            stack.pop()
        else:
            stack.append(entry["key"])
    return stack
