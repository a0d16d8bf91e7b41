"""Bits that flip in a Parquet file: it reads as what was written, or it is refused."""

from __future__ import annotations

import datetime
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from ugat_marl.data import row_hashes
from ugat_marl.data.row_hashes import HASH_KEYS, damage, write_hashed
from ugat_marl.data.runs import Metrics
from ugat_marl.errors import CheckpointError


def every_kind(rows: int) -> pl.DataFrame:
    draws = np.random.default_rng(0)
    return pl.DataFrame(
        {
            "number": draws.normal(size=rows),
            "small": draws.normal(size=rows).astype(np.float32),
            "count": draws.integers(0, 9, rows),
            "name": [None if row % 5 == 0 else f"ä{row}" for row in range(rows)],
            "flag": [None if row % 7 == 0 else row % 2 == 0 for row in range(rows)],
            "list": [None if row % 11 == 0 else [float(row)] * (row % 3) for row in range(rows)],
            "time": [datetime.datetime(2024, 1, 1, tzinfo=None)] * rows,
        },
        schema_overrides={"list": pl.List(pl.Float32)},
    ).with_columns(fixed=pl.Series(draws.normal(size=(rows, 3))))


def read(path: Path) -> tuple[pl.DataFrame, dict[str, str]]:
    return pl.read_parquet(path), pl.read_parquet_metadata(path)


@pytest.mark.parametrize("rows", [0, 1, 40])
def test_what_was_written_is_whole(rows: int, tmp_path: Path) -> None:
    write_hashed(every_kind(rows), tmp_path / "a.parquet", {"mine": "text"})
    frame, metadata = read(tmp_path / "a.parquet")
    assert frame.equals(every_kind(rows))
    assert damage(frame, metadata, ("mine",)) == ""


def test_every_flipped_bit_of_the_numbers_is_seen(tmp_path: Path) -> None:
    """A table with single bits flipped, each in a file of its own."""
    path = tmp_path / "a.parquet"
    frame = every_kind(40)
    write_hashed(frame, path, {"mine": "text"})
    content = path.read_bytes()
    other = 0
    places = np.random.default_rng(1).integers(0, 8 * len(content), 600)
    for place in places.tolist():
        flipped = bytearray(content)
        flipped[place // 8] ^= 1 << place % 8
        path.write_bytes(flipped)
        try:
            got, metadata = read(path)
            wrong = damage(got, metadata, ("mine",))
            hashed = any(key in metadata for key in HASH_KEYS)
        except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError, ValueError):
            continue
        other += hashed and not wrong and not (got.equals(frame) and metadata["mine"] == "text")
        assert hashed
    assert other == 0


def test_the_row_group_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(row_hashes, "_GROUP_ROWS", 10)
    frame = every_kind(35)
    write_hashed(frame, tmp_path / "a.parquet")
    got, metadata = read(tmp_path / "a.parquet")
    changed = got.with_row_index().with_columns(
        count=pl.when(pl.col("index") == 23).then(99).otherwise(pl.col("count"))
    )
    wrong = damage(changed.drop("index"), metadata)
    assert wrong == "row group 2 (rows 20 to 29) is not what was written"
    assert damage(got.head(34), metadata) == "it has 34 rows, and had 35 when it was written"
    assert "hashes are damaged" in damage(got, {**metadata, HASH_KEYS[0]: "{}"})
    assert "hashes are damaged" in damage(got, {HASH_KEYS[1]: metadata[HASH_KEYS[1]]})


def test_a_damaged_table_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "metrics.parquet"
    Metrics([("real", 0, "att_s", 1.0)]).write(path)
    metadata = pl.read_parquet_metadata(path)
    kept = {key: metadata[key] for key in HASH_KEYS}
    frame = pl.read_parquet(path)
    frame.with_columns(pl.Series(frame.columns[-1], [2.0])).write_parquet(path, metadata=kept)
    with pytest.raises(CheckpointError, match=r"damaged, row group 0 \(rows 0 to 0\) is not"):
        Metrics.read(path)
