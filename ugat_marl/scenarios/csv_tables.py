"""Rows of CSV tables that people write: what is ambiguous is refused, with its line."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ugat_marl.errors import ScenarioError


def delimiter_of(text: str) -> str:
    """Return what separates cells: a semicolon if the first line has one, else a comma."""
    return ";" if ";" in text.partition("\n")[0] else ","


def columns_of(reader: csv.DictReader[str], path: Path) -> list[str]:
    """Read the first line; return the names without blanks, which then name the cells of rows.

    Raises:
        ScenarioError: It is not CSV, or holds a name twice.
    """
    try:
        columns = [name.strip() for name in reader.fieldnames or ()]
    except csv.Error as error:
        raise ScenarioError(f"{path}, line 1: not CSV ({error})") from None
    if twice := [name for name in dict.fromkeys(columns) if name and columns.count(name) > 1]:
        raise ScenarioError(f"{path}, line 1: the column {twice[0]} is there twice; keep one")
    reader.fieldnames = columns
    return columns


def rows_of(reader: csv.DictReader[str], path: Path) -> Iterator[dict[str, str]]:
    """Return the rows, with `reader.line_num` as their line.

    Raises:
        ScenarioError: A row is not CSV, or holds more cells than there are columns.
    """
    try:
        for row in reader:
            cells: dict[str | None, Any] = {**row}
            if more := [text for text in cells.get(None) or () if text.strip()]:
                raise ScenarioError(
                    f"{path}, line {reader.line_num}: {more[0]!r} is beyond the last column; a "
                    "decimal comma needs semicolons between the columns"
                )
            yield row
    except csv.Error as error:
        raise ScenarioError(f"{path}, line {reader.line_num + 1}: not CSV ({error})") from None
