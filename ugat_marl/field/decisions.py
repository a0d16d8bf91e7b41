"""Decisions of the field loop, and the log that they are written to."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ugat_marl.errors import OptionError, OutputError
from ugat_marl.files import lock, require_writable

_SEGMENT_BYTES = 1 << 20
"""Size from which a segment is closed, bytes. A larger one delays one decision in a day for longer.
A smaller one waits more often for the disk."""
_MOST_WAITING = 100_000
"""Most decisions that wait in memory for a disk that is full: 11 days of one in 10 s."""
_AT_ONCE = 64
"""Most waiting decisions that one decision writes, so that none takes long after a full disk."""

_HASHED = re.compile(rb'(\{.*), "hash": "([0-9a-f]{16})"\}\n')
"""A line without its hash, and the hash."""

_BEGINS = b'{"time_s": '
"""Begin of every line."""

Source = Literal["policy", "fallback", "both"]


@dataclass(frozen=True)
class Decision:
    """One decision for all lights.

    Attributes:
        time_s: Time of the decision on the street's clock, s.
        phases: Traffic light to the phase asked for.
        fallback: Traffic light that follows the fixed-time plan to the reason.
        read_ms: Time spent on reading and checking the counts, ms.
        latency_ms: Time from the start of reading until every light was set, ms; until every light
            had its plan in what `FieldLoop.decide` returns.
    """

    time_s: float
    phases: Mapping[str, int]
    fallback: Mapping[str, str]
    read_ms: float
    latency_ms: float

    @property
    def source(self) -> Source:
        """Source of the decision: the policy, the fixed-time plan, or both."""
        if not self.fallback:
            return "policy"
        return "fallback" if len(self.fallback) == len(self.phases) else "both"

    def line(self) -> bytes:
        """Return the decision as a line of JSON, with a hash of the line as its last value."""
        text = json.dumps(
            {
                "time_s": self.time_s,
                "source": self.source,
                "reasons": dict(self.fallback),
                "phases": dict(self.phases),
                "read_ms": round(self.read_ms, 3),
                "latency_ms": round(self.latency_ms, 3),
            }
        ).encode()
        return text[:-1] + b', "hash": "%s"}\n' % _line_hash(text)


class DecisionLog:
    """File with one line of JSON per decision; the time to add a line does not grow with the file.

    Each line is written at once to a segment beside the file, ``NAME.OFFSET.part``. OFFSET is the
    place of the segment in the file, in bytes. A full segment is added to the file and removed; so
    is the last one in `close`. A killed loop leaves its segment, and the next log of that name adds
    it first. A killed loop therefore loses at most the line that it was writing. Lines that the
    file already holds are kept.

    If the disk is full for a while, the lights go on, and the next decisions try again.

    Args:
        path: The file. It is locked until `close`.

    Attributes:
        lost: Number of decisions that were dropped because the disk was full for too long.

    Raises:
        OutputError: The file cannot be written.
        OptionError: Another loop writes to the file, or the file does not end with a whole line.
    """

    def __init__(self, path: str | Path) -> None:
        path = Path(path)
        require_writable(path)
        self.path = path
        self.lost = 0
        self._waiting: list[bytes] = []
        self._file = self._segment = -1  # descriptors; -1 while there is none
        self._part = path
        self._size = 0
        try:
            self._open_file()
            self._require_whole()
            self._merge()
        except BlockingIOError:
            self._release()
            raise OptionError(
                f"{path}: another loop writes to this log; give this one another name"
            ) from None
        except OSError as error:
            self._release()
            raise OutputError(
                f"{path}: cannot be written ({error.strerror}); give another place"
            ) from None
        except OptionError:
            self._release()
            raise

    def add(self, decision: Decision) -> None:
        """Write the line of a decision; keep it for the next call if the disk is full."""
        self._waiting.append(decision.line())
        if len(self._waiting) > _MOST_WAITING:
            del self._waiting[0]
            self.lost += 1
        with contextlib.suppress(OSError):  # a full disk does not stop the lights
            self._write()

    def close(self) -> None:
        """Write what is left, add the last segment to the file and release the file.

        Raises:
            OutputError: The disk is full, or the folder is gone.
        """
        try:
            while self._waiting:
                self._write()
            if self._segment >= 0:
                self._rotate()
        except OSError as error:
            raise OutputError(
                f"{self.path}: cannot be completed ({error.strerror}); make room and begin a loop "
                f"with this log again, which adds the lines in {self.path.name}.*.part"
            ) from None
        finally:
            self._release()

    def _write(self) -> None:
        """Write some of the waiting lines to the segment."""
        if not _is_at(self._segment, self._part):
            self._begin()
        lines = b"".join(self._waiting[:_AT_ONCE])
        # A write that fails in its middle is repeated at the same place.
        _write_at(self._segment, lines, self._size)
        self._size, self._waiting = self._size + len(lines), self._waiting[_AT_ONCE:]
        if self._size >= _SEGMENT_BYTES:
            self._rotate()

    def _begin(self) -> None:
        """Begin a segment behind the file and the segments that are still to be added to it."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._find_file()
        end = os.fstat(self._file).st_size + sum(part.stat().st_size for _, part in self._parts())
        self._part = self.path.with_name(f"{self.path.name}.{end:015d}.part")
        if self._segment >= 0:
            deleted, self._segment = self._segment, -1
            os.close(deleted)
        self._segment = os.open(self._part, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
        self._size = 0

    def _rotate(self) -> None:
        """Close the segment and add it to the file."""
        segment, self._segment = self._segment, -1
        try:
            os.ftruncate(segment, self._size)
        finally:
            os.close(segment)
        self._merge()

    def _merge(self) -> None:
        """Add all segments to the file. A merge that was killed at any point is completed."""
        self._find_file()
        for offset, part in self._parts():
            lines = _whole_lines(part)
            size = os.fstat(self._file).st_size
            try:
                _write_at(self._file, lines[self._overlap(offset, lines) :], size)
            except OSError:
                os.ftruncate(self._file, size)
                raise
            os.fsync(self._file)  # before the only other copy goes
            part.unlink()

    def _find_file(self) -> None:
        """Open the file again if it was deleted or renamed, as a rotation of logs does."""
        if not _is_at(self._file, self.path):
            self._release()
            self._open_file()

    def _overlap(self, offset: int, lines: bytes) -> int:
        """Return the number of bytes at the start of a segment that the file ends with."""
        length = os.fstat(self._file).st_size - offset
        if 0 < length <= len(lines) and os.pread(self._file, length, offset) == lines[:length]:
            return length
        return 0

    def _parts(self) -> list[tuple[int, Path]]:
        """Return the segments with their places in the file, in order."""
        names = re.compile(re.escape(self.path.name) + r"\.(\d{15})\.part")
        matches = ((names.fullmatch(part.name), part) for part in self.path.parent.iterdir())
        return sorted((int(match[1]), part) for match, part in matches if match)

    def _open_file(self) -> None:
        self._file = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            lock(self._file)
        except BlockingIOError:
            self._release()
            raise

    def _require_whole(self) -> None:
        """Refuse a file of something else, or whose last line has no end.

        A merge that was killed may have left it so.
        """
        size = os.fstat(self._file).st_size
        if not _BEGINS.startswith(os.pread(self._file, len(_BEGINS), 0)):
            raise OptionError(
                f"{self.path}: holds something else than decisions; give the log another name"
            )
        if size == 0 or os.pread(self._file, 1, size - 1) == b"\n":
            return
        if not any(self._overlap(offset, _whole_lines(part)) for offset, part in self._parts()[:1]):
            raise OptionError(
                f"{self.path}: does not end with a whole line; give the log another name"
            )

    def _release(self) -> None:
        for descriptor in (self._segment, self._file):
            if descriptor >= 0:
                os.close(descriptor)
        self._segment = self._file = -1


def read_decisions(path: str | Path) -> Iterator[dict[str, Any]]:
    """Yield the decisions of a log, as values of JSON, and refuse a damaged line.

    Args:
        path: File of a `DecisionLog`, or a segment of a loop that runs.

    Raises:
        OptionError: There is no such file, or a line is not what was written.
    """
    try:
        with Path(path).open("rb") as lines:
            for number, line in enumerate(lines, 1):
                decision = _decision_in(line)
                if decision is None:
                    raise OptionError(
                        f"{path}: line {number} is not what was written; copy the log again, or "
                        "remove the line"
                    )
                yield decision
    except OSError as error:
        raise OptionError(f"{path}: cannot be read ({error.strerror}); name a log") from None


def _decision_in(line: bytes) -> dict[str, Any] | None:
    """Return the decision in a line of a log; None if the line is not what was written."""
    match = _HASHED.fullmatch(line)
    if match is None or _line_hash(text := match[1] + b"}") != match[2]:
        return None
    try:
        return json.loads(text)
    except ValueError:
        return None


def _line_hash(text: bytes) -> bytes:
    return hashlib.blake2b(text, digest_size=8).hexdigest().encode()


def _whole_lines(part: Path) -> bytes:
    """Return a segment without a last line that was not written to its end."""
    content = part.read_bytes()
    return content[: content.rfind(b"\n") + 1]


def _is_at(descriptor: int, path: Path) -> bool:
    """Return True if a path leads to an open file; a descriptor of -1 is none."""
    try:
        return descriptor >= 0 and os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def _write_at(descriptor: int, content: bytes, offset: int) -> None:
    """Write all of `content` at a place of a file.

    Raises:
        OSError: The disk is full; a part may have been written.
    """
    written = os.pwrite(descriptor, content, offset) if content else 0
    if written < len(content):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
