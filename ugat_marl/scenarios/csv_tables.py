"""Rows of CSV tables that people write: what is ambiguous is refused, with its line."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ugat_marl.errors import ScenarioError
from ugat_marl.scenarios.settings import parse_decimal

_QUOTED = re.compile(r'"[^"]*"')
_DECIMAL_COMMA = re.compile(r"\s*[+-]?\d*,\d+\s*", re.ASCII)


def delimiter_of(text: str) -> str:
    """Return what separates cells: what the first line has most of outside of quotes."""
    head = _QUOTED.sub("", text.partition("\n")[0])
    most = max(";\t,", key=head.count)
    return most if most in head else ","


def with_point(cell: str) -> str:
    """Return the text of a cell, with a point if it is a number with a decimal comma.

    No other cell holds a comma between digits: names in SUMO have none.
    """
    return cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell


def columns_of(reader: csv.DictReader[str], path: Path) -> list[str]:
    """Read the first line; return the names in small letters, which then name the cells of rows.

    Raises:
        ScenarioError: It is not CSV, tells a spreadsheet its separator, or holds a name twice.
    """
    try:
        columns = [name.strip().lower() for name in reader.fieldnames or ()]
    except csv.Error as error:
        raise ScenarioError(f"{path}, line 1: not CSV ({error})") from None
    if columns and columns[0].startswith("sep="):
        raise ScenarioError(
            f"{path}, line 1: {columns[0]!r} is for a spreadsheet; delete this line, so that the "
            "file begins with the names of its columns"
        )
    if twice := [name for name in dict.fromkeys(columns) if name and columns.count(name) > 1]:
        raise ScenarioError(f"{path}, line 1: the column {twice[0]} is there twice; keep one")
    reader.fieldnames = columns
    return columns


def rows_of(reader: csv.DictReader[str], path: Path) -> Iterator[dict[str, str]]:
    """Return the rows, with `reader.line_num` as their line.

    Numbers have points: where no comma separates the cells, it is the decimal point.

    Raises:
        ScenarioError: A row is not CSV, or holds more cells than there are columns.
    """
    comma_is_point = reader.reader.dialect.delimiter != ","
    try:
        for row in reader:
            cells: dict[Any, Any] = {**row}
            if more := [text for text in cells.get(None) or () if text.strip()]:
                raise ScenarioError(
                    f"{path}, line {reader.line_num}: {more[0]!r} is beyond the last column; put "
                    "cells that hold commas in quotes, or semicolons between the columns"
                )
            if comma_is_point:
                row = {k: with_point(v) if isinstance(v, str) else v for k, v in cells.items()}
            yield row
    except csv.Error as error:
        raise ScenarioError(f"{path}, line {reader.line_num + 1}: not CSV ({error})") from None


def number_in(text: str | None) -> float:
    """Return the number in a cell, as `parse_decimal` reads it; NaN for anything else."""
    try:
        return parse_decimal(text or "")
    except ValueError:
        return math.nan


_FORMULA = "=+-@\t\r"
"""First characters that make a spreadsheet read a text as a formula."""


def as_text(cell: str) -> str:
    """Return a cell that a spreadsheet takes for text, and not for a formula."""
    return f"'{cell}" if cell and cell[0] in _FORMULA else cell
