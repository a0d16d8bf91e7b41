"""The columns of a transition log, and every way in which a table can fail to be one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import polars as pl

from ugat_marl.errors import LogError

SCHEMA: Mapping[str, pl.DataType] = {
    "episode": pl.Int32(),
    "step": pl.Int32(),
    "agent": pl.String(),
    "observation": pl.List(pl.Float32()),
    "action": pl.Int16(),
    "executed": pl.Int16(),
    "delay_s": pl.Float32(),
    "reward": pl.Float32(),
    "next_observation": pl.List(pl.Float32()),
    "served_features": pl.List(pl.Float32()),
}
OPTIONAL: Mapping[str, pl.Expr] = {
    "delay_s": pl.lit(0.0, pl.Float32()),
    "served_features": pl.lit([], pl.List(pl.Float32())),
}
"""Columns that may be missing, and what they hold then."""
VECTORS = ("observation", "next_observation")
CHOICES = ("action", "executed")


def read_parquet(path: Path) -> tuple[pl.DataFrame, dict[str, str]]:
    """The table in a Parquet file and the file's metadata.

    Raises:
        LogError: Missing, unreadable, cut short or damaged.
    """
    _refuse_half_file(path)
    try:
        return pl.read_parquet(path), pl.read_parquet_metadata(path)
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError) as error:
        raise LogError(
            f"{path}: damaged Parquet file ({_first_line(error)}); record or copy it again"
        ) from None


def checked(
    frame: pl.DataFrame,
    sizes: Mapping[str, int],
    phases: Mapping[str, int],
    features: Mapping[str, int],
) -> pl.DataFrame:
    """The frame with exactly the columns and types of `SCHEMA`, every value possible.

    Args:
        frame: Any table; wider number types are converted where nothing is lost.
        sizes: Agent to the length of its observation vector.
        phases: Agent to its number of green phases.
        features: Agent to its number of features.

    Raises:
        LogError: Names the column, and the first row at fault.
    """
    frame = _converted(frame)
    for column in SCHEMA:
        if frame[column].null_count():
            raise LogError(f"column {column!r} has missing values; drop or fill those rows")
    unknown = set(frame["agent"].unique()) - set(sizes)
    if unknown:
        raise LogError(f"unknown agents {sorted(unknown)}; the provenance has {sorted(sizes)}")
    agent = pl.col("agent")
    size = agent.replace_strict(dict(sizes), return_dtype=pl.UInt32)
    limit = agent.replace_strict(dict(phases), return_dtype=pl.Int16)
    own = agent.replace_strict(dict(features), return_dtype=pl.UInt32)
    length = pl.col("served_features").list.len()
    wrong = (length != own) & (length != 0)
    _refuse_rows(frame, wrong, "served_features", "has the wrong length")
    for column in VECTORS:
        _refuse_rows(frame, pl.col(column).list.len() != size, column, "has the wrong length")
    for column in (*VECTORS, "served_features"):
        bad = ~pl.col(column).list.eval(pl.element().is_finite().fill_null(False)).list.all()
        _refuse_rows(frame, bad, column, "holds a number that is not finite")
    for column in CHOICES:
        bad = (pl.col(column) < 0) | (pl.col(column) >= limit)
        _refuse_rows(frame, bad, column, "is no phase of its agent")
    _refuse_rows(frame, ~pl.col("reward").is_finite(), "reward", "is not finite")
    delay = pl.col("delay_s")
    _refuse_rows(frame, ~delay.is_finite() | (delay < 0), "delay_s", "is no time to wait")
    key = ["episode", "step", "agent"]
    _refuse_rows(frame, pl.struct(key).is_duplicated(), "step", "occurs twice in its episode")
    return frame


def _converted(frame: pl.DataFrame) -> pl.DataFrame:
    columns: list[pl.Series] = []
    absent = [name for name in OPTIONAL if name not in frame.columns]
    frame = frame.with_columns(OPTIONAL[name].alias(name) for name in absent)
    for name, wanted in SCHEMA.items():
        if name not in frame.columns:
            raise LogError(f"column {name!r} is missing; a log has {', '.join(SCHEMA)}")
        column = frame[name]
        if not _same_kind(column.dtype, wanted):
            raise LogError(f"column {name!r} has type {column.dtype}; expected {wanted}")
        try:
            columns.append(column.cast(wanted))
        except pl.exceptions.PolarsError as error:
            raise LogError(
                f"column {name!r} does not fit into {wanted}: {_first_line(error)}"
            ) from None
    return pl.DataFrame(columns)


def _same_kind(found: pl.DataType, wanted: pl.DataType) -> bool:
    if isinstance(wanted, pl.List):
        if not isinstance(found, pl.List | pl.Array):
            return False
        return found.inner.is_float()
    if wanted.is_integer():
        return found.is_integer()
    if wanted.is_float():
        return found.is_float()
    return found == wanted


def _refuse_rows(frame: pl.DataFrame, bad: pl.Expr, column: str, complaint: str) -> None:
    wrong = frame.filter(bad)
    if not wrong.is_empty():
        row = wrong.row(0, named=True)
        place = f"episode {row['episode']}, step {row['step']}, agent {row['agent']}"
        value = str(row[column])
        shown = value if len(value) <= 80 else value[:77] + "..."
        raise LogError(
            f"{place}: {column} {complaint} ({shown}); {wrong.height} of {frame.height} rows"
        )


def _refuse_half_file(path: Path) -> None:
    """A Parquet file begins and ends with its magic number; half a file does not."""
    try:
        with path.open("rb") as file:
            head = file.read(4)
            file.seek(0, 2)
            size = file.tell()
            file.seek(max(0, size - 4))
            tail = file.read(4)
    except OSError as error:
        way_out = "check the path" if isinstance(error, FileNotFoundError) else "make it readable"
        raise LogError(f"{path}: cannot be read ({error.strerror}); {way_out}") from None
    if head != b"PAR1":
        raise LogError(f"{path}: not a Parquet file; record it with TransitionLog.write")
    if tail != b"PAR1":
        raise LogError(
            f"{path}: the Parquet file is cut short ({size} bytes, no footer); "
            "record or copy it again"
        )


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
