"""Text files as UTF-8, in blocks of whole lines, whatever they are encoded in."""

from __future__ import annotations

import codecs
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import IO

_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_PIECE = 1 << 20  # bytes transcoded at a time


@dataclass
class Untouched:
    """All of a file behind its first ``lines`` lines, which end at byte ``offset``; read only if it must be:
    a parser does that for itself, without a copy."""

    path: Path
    lines: int
    offset: int

    @cached_property
    def text(self) -> bytes:
        with self.path.open("rb") as file:
            file.seek(self.offset)
            return _utf8(file.read())

    def __len__(self) -> int:
        return self.path.stat().st_size - self.offset


@dataclass
class TextFile:
    """A text file: UTF-8 or UTF-16 by its byte order mark, else UTF-8, else Latin-1; any line end.

    ``remainder`` is what stood behind the last line end, once :meth:`blocks` has come to its end.
    """

    path: Path
    notes: list[str] = field(default_factory=list)
    remainder: bytes = b""

    def __post_init__(self) -> None:
        with self.path.open("rb") as file:
            first = file.read(_PIECE)
        self.utf_16 = first[:2] in _UTF_16
        text = first.decode("utf-16", "ignore").encode() if self.utf_16 else first
        self.bare_returns = b"\r" in text and b"\n" not in text  # as old Macs end their lines
        self.zeros = not self.utf_16 and b"\0" in text

    def head(self, size: int) -> bytes:
        """The first ``size`` bytes of the text or a little more; up to a line end if one follows."""
        text = b""
        with self.path.open("rb") as file:
            for piece in self._pieces(file, _PIECE):
                text += piece
                if len(text) >= size:
                    break
            whole = not file.read(1)
        return _utf8(text if whole or b"\n" not in text else text[: text.rfind(b"\n") + 1])

    def blocks(self, skip: int, size: int | None) -> Iterator[bytes]:
        """The text behind its first ``skip`` bytes, in blocks of about ``size`` bytes (None: one block)."""
        carry = b""
        with self.path.open("rb") as file:
            if (offset := self._offset(skip)) is not None:
                file.seek(offset)
                skip = 0
            for piece in self._pieces(file, size):
                text = self._without_zeros(piece)
                end = text.rfind(b"\n") + 1
                block = _utf8(carry + text[:end] if carry or end < len(text) else text) if end else b""
                carry = text[end:] if end else carry + text
                block, skip = block[skip:], max(0, skip - len(block))
                if block:
                    yield block
        self.remainder = _utf8(carry)[skip:]

    def untouched(self, skip: int) -> Untouched | None:
        """The text behind its first ``skip`` bytes, which are whole lines; None unless all the file's lines
        are whole."""
        offset = self._offset(skip)
        with self.path.open("rb") as file:
            file.seek(-min(1, self.path.stat().st_size), os.SEEK_END)
            if offset is None or file.read() != b"\n":
                return None
            file.seek(0)
            return Untouched(self.path, file.read(offset).count(b"\n"), offset)

    def _offset(self, skip: int) -> int | None:
        """Where in the file the text behind its first ``skip`` bytes begins, which are whole lines: behind as
        many lines. None where the file's lines are not those of the text."""
        if self.utf_16 or self.bare_returns or self.zeros:
            return None
        lines = self.head(skip)[:skip].count(b"\n")
        with self.path.open("rb") as file:
            return sum(len(file.readline()) for _ in range(lines))

    def _pieces(self, file: IO[bytes], size: int | None) -> Iterator[bytes]:
        decoder = codecs.getincrementaldecoder("utf-16")("replace") if self.utf_16 else None
        first = file.tell() == 0
        while piece := file.read(size or -1):
            text = decoder.decode(piece).encode() if decoder else piece
            text = text.removeprefix(codecs.BOM_UTF8) if first else text
            yield text.replace(b"\r", b"\n") if self.bare_returns else text
            first = False

    def _without_zeros(self, text: bytes) -> bytes:
        """Without the zero bytes that a crashed logger leaves where it had reserved space."""
        if not text.endswith(b"\0"):
            return text
        told = "zero bytes at the end, as a crashed logger leaves them, were dropped"
        self.notes += [told] if told not in self.notes else []
        return text.rstrip(b"\0")


def _utf8(lines: bytes) -> bytes:
    if lines.isascii():
        return lines
    try:
        lines.decode()
    except UnicodeDecodeError as error:
        end = lines.find(b"\n", error.end) + 1
        if end and lines[end:].isascii():  # as a rule only the names are not
            return lines[:end].decode("latin-1").encode() + lines[end:]
        return lines.decode("latin-1").encode()
    return lines
