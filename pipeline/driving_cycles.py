"""Fault codes over driving cycles, as on-board diagnosis keeps them (dissertation, 5.1).

A log is a driving cycle of its vehicle. A fault seen for the first time is *pending*; seen in two cycles in a
row it is *confirmed*, and lights the malfunction indicator. Three cycles in a row without any fault turn it
off: the code is *healed*, and goes after forty more. A pending code goes with the first such cycle. A cycle
with too little evidence, or whose log failed, says nothing and breaks no row.

A fault that a cycle cannot tell from the named one (it is in the verdict's ``set``) counts as seen again, not
as seen for the first time.

What is known is kept in a small file, so that codes go on where the logs of earlier cycles are gone. The
codes follow from the list of cycles alone, in order of start time, or of name where a vehicle's logs do not
all have one: it does not matter in which order, or in how many batches, they were diagnosed.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from ingest.errors import LogError
from pipeline.files import write_aside

CONFIRM, HEAL, FORGET = 2, 3, 40  # cycles in a row
NO_FAULT, NO_WORD = "none", "insufficient_evidence"
FORMAT = 1


@dataclass(frozen=True, kw_only=True)
class Cycle:
    """What one log said of its vehicle."""

    log: str
    start_time: str | None
    fault: str
    set: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Code:
    """A stored fault code; ``seen`` and ``clean`` count the last cycles in a row with and without it."""

    status: Literal["pending", "confirmed", "healed"]
    seen: int
    clean: int
    first: str
    last: str


Codes = Mapping[str, Code]


def after(codes: Codes, cycle: Cycle) -> dict[str, Code]:
    """The codes after one more cycle.

    >>> one = Cycle(log="a", start_time=None, fault="boost_leak", set=("boost_leak",))
    >>> once = after({}, one)
    >>> after(once, one)["boost_leak"].status
    'confirmed'
    """
    if cycle.fault == NO_WORD:
        return dict(codes)
    found: dict[str, Code] = {}
    for fault, code in codes.items():
        if fault == cycle.fault or fault in cycle.set:
            found[fault] = _again(code, cycle.log)
        elif kept := _without(code, clean=cycle.fault == NO_FAULT):
            found[fault] = kept
    if cycle.fault not in (NO_FAULT, *found):
        found[cycle.fault] = Code(status="pending", seen=1, clean=0, first=cycle.log, last=cycle.log)
    return dict(sorted(found.items()))


def _again(code: Code, log: str) -> Code:
    seen = code.seen + 1
    if code.status == "confirmed" or seen >= CONFIRM:
        return replace(code, status="confirmed", seen=seen, clean=0, last=log)
    return replace(code, status="pending", seen=seen, clean=0, last=log)


def _without(code: Code, *, clean: bool) -> Code | None:
    """The code after a cycle without this fault; None once it is forgotten."""
    count = code.clean + 1 if clean else 0
    if code.status == "pending":
        return None if clean else replace(code, seen=0, clean=0)
    if code.status == "confirmed" and count >= HEAL:
        return replace(code, status="healed", seen=0, clean=0)
    if code.status == "healed" and count >= FORGET:
        return None
    return replace(code, seen=0, clean=count)


def lit(codes: Codes) -> bool:
    """Whether the malfunction indicator is on."""
    return any(code.status == "confirmed" for code in codes.values())


def in_order(cycles: Iterable[Cycle]) -> list[Cycle]:
    """By start time where all have one, else by name, numbers in it counting as such."""
    cycles = list(cycles)
    starts = {c.log: _instant(c.start_time) for c in cycles}
    timed = all(s is not None for s in starts.values())
    return sorted(cycles, key=lambda c: (starts[c.log] or 0.0 if timed else 0.0, _natural(c.log)))


@lru_cache(1 << 16)
def _instant(text: str | None) -> float | None:
    try:
        time = datetime.fromisoformat(text or "")
    except ValueError:
        return None
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


@lru_cache(1 << 16)
def _natural(name: str) -> list[tuple[int, int, str]]:
    """
    >>> sorted(["drive10", "drive9"], key=_natural)
    ['drive9', 'drive10']
    """
    parts = re.split(r"(\d+)", name)
    return [(1, int(p), p) if p.isdecimal() else (0, 0, p) for p in parts]


@dataclass
class Vehicles:
    """All cycles by vehicle and log, and the codes that follow from them."""

    cycles: dict[str, dict[str, Cycle]] = field(default_factory=dict)
    codes: dict[str, Codes] = field(default_factory=dict)

    def judge(self, rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
        """Takes the summary's ``rows`` in; for each log with a vehicle, its place among the vehicle's
        logs, and ``fault_codes`` and ``mil`` after it."""
        for name in [row["log"] for row in rows]:
            for known in self.cycles.values():
                known.pop(name, None)  # as it was said before
        for row in rows:
            if row.get("vehicle") and row.get("fault"):
                cycle = Cycle(
                    log=row["log"], start_time=row.get("start_time"), fault=row["fault"],
                    set=tuple((row.get("set") or "").split()),
                )  # fmt: skip
                self.cycles.setdefault(row["vehicle"], {})[cycle.log] = cycle
        told: dict[str, dict[str, Any]] = {}
        for vehicle, known in self.cycles.items():
            codes: Codes = {}
            for number, cycle in enumerate(in_order(known.values()), start=1):
                codes = after(codes, cycle)
                words = " ".join(f"{fault}:{code.status}" for fault, code in codes.items())
                told[cycle.log] = {"cycle": number, "fault_codes": words or None, "mil": lit(codes)}
            self.codes[vehicle] = codes
        return told

    @classmethod
    def load(cls, path: Path) -> Vehicles:
        """What an earlier batch left, or nothing.

        Raises:
            LogError: the file is there but is not one of ours.
        """
        try:
            kept = json.loads(path.read_text(encoding="utf-8"))
            if kept["format"] != FORMAT:
                raise ValueError(f"its format is {kept['format']!r}, this version knows {FORMAT}")
            cycles = {
                vehicle: {c["log"]: Cycle(**{**c, "set": tuple(c["set"])}) for c in v["cycles"]}
                for vehicle, v in kept["vehicles"].items()
            }
        except FileNotFoundError:
            return cls()
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise LogError(
                f"{path}, what is known of the vehicles' earlier logs, cannot be read: {error}; "
                "put it right, or move it away to begin anew"
            ) from None
        return cls(cycles)

    def save(self, path: Path) -> None:
        """Replaces the file; it is there from the first vehicle on."""
        vehicles = [
            f" {json.dumps(vehicle, ensure_ascii=False)}: {{\n{self._text(vehicle)}}}"
            for vehicle, known in sorted(self.cycles.items())
            if known
        ]
        if vehicles or path.exists():
            text = f'{{"format": {FORMAT}, "vehicles": {{\n' + ",\n".join(vehicles) + "\n}}\n"
            write_aside(path, text.encode())

    def _text(self, vehicle: str) -> str:
        """A vehicle as JSON, a cycle a line: the library's own lines are written ten times as slowly."""
        codes = {fault: vars(code) for fault, code in self.codes.get(vehicle, {}).items()}
        head = json.dumps({"mil": lit(self.codes.get(vehicle, {})), "codes": codes})[1:-1]
        lines = [json.dumps(vars(c), ensure_ascii=False) for c in in_order(self.cycles[vehicle].values())]
        return f"  {head},\n  " + '"cycles": [\n   ' + ",\n   ".join(lines) + "\n  ]\n "
