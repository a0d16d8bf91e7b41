"""Long files, read piece by piece with progress; errors name the line."""

from __future__ import annotations

import codecs
import io
import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, cast

from ugat_marl.errors import ScenarioError
from ugat_marl.files import Tag, chunks_of, parse_json, read_bytes, require_bounded, scan_xml
from ugat_marl.progress import Reporter

_MOST = 32 << 20
"""Most characters of one object or line. A longer one means that the file is damaged."""
_BEFORE, _BETWEEN = re.compile(r"[ \t\r\n]*"), re.compile(r"[ \t\r\n,]*")

Pieces = Iterable[bytes]


def scan(path: Path, reporter: Reporter) -> Iterator[Tag]:
    """Yield the elements of an XML file of any length.

    Raises:
        ScenarioError: As for `ugat_marl.files.scan_xml`.
    """
    return scan_xml(chunks_of(path, reporter), str(path))


def objects(path: Path, reporter: Reporter) -> Iterator[tuple[dict[str, Any], int]]:
    """Yield the objects in the list of a JSON file, each with its line.

    Raises:
        ScenarioError: The file is not JSON, or not a list of objects.
    """
    decoder = json.JSONDecoder()
    text, at, line, opened = "", 0, 1, False
    pieces = _texts(chunks_of(path, reporter), path)
    while True:
        blank = (_BETWEEN if opened else _BEFORE).match(text, at)
        assert blank is not None
        line += text.count("\n", at, blank.end())
        at = blank.end()
        if at < len(text) and not opened:
            if text[at] != "[":
                raise ScenarioError(f"{path}, line {line}: a list of vehicles begins with [")
            at, opened = at + 1, True
            continue
        if text.startswith("]", at):
            return
        try:
            parsed_object, end = decoder.raw_decode(text, at)
        except json.JSONDecodeError as error:
            piece = next(pieces, "")
            if not piece or len(text) - at > _MOST:
                raise ScenarioError(
                    f"{path}, line {line + text.count(chr(10), at, error.pos)}: not valid JSON "
                    f"({error.msg}); the file may have been cut short"
                ) from None
            text, at = text[at:] + piece, 0
            continue
        except (RecursionError, ValueError) as error:
            raise _strange(f"{path}, line {line}", error) from None
        if not isinstance(parsed_object, dict):
            raise ScenarioError(f"{path}, line {line}: an object in braces was expected here")
        require_bounded(parsed_object, f"{path}, line {line}", ScenarioError)
        yield cast("dict[str, Any]", parsed_object), line
        line += text.count("\n", at, end)
        at = end


def lines(path: Path, reporter: Reporter) -> Iterator[str]:
    """Yield the lines of a text file of any length, with their ends.

    Raises:
        ScenarioError: The file is not UTF-8, or has a line too long for a table.
    """
    rest, count = "", 0
    for text in _texts(chunks_of(path, reporter), path):
        # lines end as in CSV: `str.splitlines` would also end them at marks inside of names
        *whole, rest = io.StringIO(rest + text, newline="").readlines() or [""]
        count += len(whole)
        yield from whole
        if len(rest) > _MOST:
            raise ScenarioError(
                f"{path}, line {count + 1}: is longer than a line of a table can be; the file may "
                "be of another kind"
            )
    if rest:
        yield rest


def read_json(path: Path) -> tuple[Any, str]:
    """Return the content of a JSON file, and its text.

    Raises:
        ScenarioError: As for `ugat_marl.files.read_json`.
    """
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{path}: is not UTF-8: {error}") from None
    return parse_json(text, str(path), ScenarioError), text


def _strange(where: str, error: Exception) -> ScenarioError:
    """Return the error for JSON that exceeds the limits of Python's reader."""
    fault = "nested too deeply" if isinstance(error, RecursionError) else "a number is far too long"
    return ScenarioError(f"{where}: {fault}; no file of CityFlow's is like that")


def _texts(pieces: Pieces, path: Path) -> Iterator[str]:
    """Decode the pieces as UTF-8 and yield those that are not empty."""
    decoder = codecs.getincrementaldecoder("utf-8-sig")()
    try:
        for piece in pieces:
            if text := decoder.decode(piece):
                yield text
        decoder.decode(b"", final=True)
    except UnicodeDecodeError:
        raise ScenarioError(
            f"{path}: is not UTF-8; save it again in UTF-8 (in a spreadsheet: CSV UTF-8)"
        ) from None
