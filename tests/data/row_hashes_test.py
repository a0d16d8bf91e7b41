"""Bits that flip in a Parquet file: it reads as what was written, or it is refused."""

from __future__ import annotations

import datetime
import errno
import json
import os
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from ugat_marl.data import row_hashes
from ugat_marl.data.measured.tables import read_raw
from ugat_marl.data.row_hashes import (
    CSV_HASHES,
    HASH_KEYS,
    csv_damage,
    csv_texts,
    damage,
    json_damage,
    read_quietly,
    with_hashes,
    write_csv,
    write_hashed,
)
from ugat_marl.data.runs import Metrics
from ugat_marl.data.transitions import read_parquet
from ugat_marl.errors import CheckpointError, LogError, MeasuredDataError
from ugat_marl.files import only_writer


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


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_full_disk_is_an_error_of_the_system() -> None:
    with pytest.raises(OSError, match=re.escape(os.strerror(errno.ENOSPC))) as raised:
        write_hashed(every_kind(40), Path("/dev/full"))
    assert raised.value.errno == errno.ENOSPC


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


def test_a_table_with_an_empty_cell_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "metrics.parquet"
    Metrics([("real", 0, "att_s", 1.0)]).write(path)
    metadata = pl.read_parquet_metadata(path)
    kept = {key: value for key, value in metadata.items() if key not in HASH_KEYS}
    frame = pl.read_parquet(path)
    step = frame.columns[1]
    frame.with_columns(pl.lit(None, frame.schema[step]).alias(step)).write_parquet(
        path, metadata={key: value for key, value in kept.items() if key != "ARROW:schema"}
    )
    with pytest.raises(CheckpointError):
        Metrics.read(path)


def csv_of(tmp_path: Path, rows: int) -> Path:
    path = tmp_path / "a.csv"
    lines = "".join(f"n{row},{row / 4}\n" for row in range(rows))
    write_csv(path, f"name,value\n{lines}")
    return path


def csv_fault(path: Path) -> str:
    return csv_damage(path, csv_texts(path.read_bytes()))


def test_a_small_file_of_very_many_rows_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(row_hashes, "_FEW_CELLS", 1000)
    packed, honest = tmp_path / "packed.parquet", tmp_path / "honest.parquet"
    pl.DataFrame({"a": np.zeros(500_000)}).write_parquet(packed)
    pl.DataFrame({"a": np.random.default_rng(1).random(5000)}).write_parquet(honest)
    says = r"500000 rows in \d+ bytes"
    with pytest.raises(pl.exceptions.ComputeError, match=says):
        read_quietly(packed)
    with pytest.raises(MeasuredDataError, match=rf"packed\.parquet: .*{says}"):
        read_raw(packed, [])
    with pytest.raises(LogError, match=rf"packed\.parquet: .*{says}"):
        read_parquet(packed)
    assert read_quietly(honest)[0].height == 5000


@pytest.mark.parametrize("rows", [0, 1, 40, 5000])
def test_a_csv_table_stays_plain_and_whole(rows: int, tmp_path: Path) -> None:
    path = csv_of(tmp_path, rows)
    assert csv_fault(path) == ""
    assert path.read_text().splitlines()[0] == "name,value"
    assert len(path.read_text().splitlines()) == rows + 1
    # Another program may end lines in another way and put quotes around cells.
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n").replace(b"name", b'"name"'))
    assert csv_fault(path) == ""


def test_flipped_bits_of_a_csv_table_are_seen(tmp_path: Path) -> None:
    path = csv_of(tmp_path, 30)
    content = path.read_bytes()
    before = csv_texts(content)
    other = 0
    for place in np.random.default_rng(2).integers(0, 8 * len(content), 300).tolist():
        flipped = bytearray(content)
        flipped[place // 8] ^= 1 << place % 8
        path.write_bytes(flipped)
        try:
            frame = csv_texts(bytes(flipped))
            wrong = csv_damage(path, frame)
        except pl.exceptions.PolarsError:
            continue
        other += not wrong and not frame.equals(before)
    assert other == 0


def test_flipped_bits_of_the_hashes_of_csv_are_seen_or_harmless(tmp_path: Path) -> None:
    path = csv_of(tmp_path, 3)
    file = tmp_path / CSV_HASHES
    content = file.read_bytes()
    stored = json.loads(content)
    for place in np.random.default_rng(3).integers(0, 8 * len(content), 300).tolist():
        flipped = bytearray(content)
        flipped[place // 8] ^= 1 << place % 8
        file.write_bytes(flipped)
        if "the hashes beside it are" not in csv_fault(path):
            assert json.loads(flipped) == stored  # white space


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        (30, r"^row 11 behind the header is not"),
        (5000, r"^rows 11 to 15 behind the header are not"),
    ],
)
def test_the_damaged_row_of_a_csv_table_is_named(rows: int, says: str, tmp_path: Path) -> None:
    path = csv_of(tmp_path, rows)
    path.write_text(path.read_text().replace("n10,2.5\n", "n10,2.9\n"))
    assert re.match(says, csv_fault(path))
    assert "remove row-hashes.json if you changed it yourself" in csv_fault(path)


def test_rows_are_counted_whatever_their_cells_hold(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    write_csv(path, 'name,text\na,"two\nlines"\nb,x\n')
    path.write_text(path.read_text().replace("b,x", "b,y"))
    assert csv_fault(path).startswith("row 2 behind the header is not what was")


def test_a_csv_table_that_lost_or_won_rows_is_damaged(tmp_path: Path) -> None:
    path = csv_of(tmp_path, 30)
    whole = path.read_text()
    path.write_text(whole.replace("n10,2.5\n", ""))
    assert csv_fault(path).startswith("row 11 behind the header is not what was written")
    path.write_text(whole + "n30,1\n")
    assert csv_fault(path).startswith("it has 31 rows, and had 30")
    path.write_text(whole.replace("value", "valve"))
    assert csv_fault(path).startswith("its columns are not those")


def test_tables_by_hand_have_no_hashes(tmp_path: Path) -> None:
    csv_of(tmp_path, 3)
    by_hand = tmp_path / "b.csv"
    by_hand.write_text("name\nx\n")
    assert csv_fault(by_hand) == ""
    write_csv(by_hand, "name\ny\n")
    by_hand.write_text("name\nx\n")
    assert csv_fault(by_hand).startswith("row 1 ")
    assert csv_fault(tmp_path / "a.csv") == ""
    (tmp_path / CSV_HASHES).unlink()
    assert csv_fault(by_hand) == ""


def test_a_table_has_its_hashes_while_the_next_one_is_made(tmp_path: Path) -> None:
    path = csv_of(tmp_path, 3)
    path.write_text(path.read_text().replace("n1,", "n7,"))

    def refusing() -> str:
        if wrong := csv_fault(path):
            raise ValueError(wrong)
        return "name,value\n"

    for _ in range(2):  # the table is kept, and its hashes too
        with pytest.raises(ValueError, match="row 2 behind the header is not"):
            write_csv(path, refusing)
    assert "n7," in path.read_text()


def test_a_damaged_file_prints_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Threads of polars would print their stack traces."""
    path = tmp_path / "a.parquet"
    every_kind(40).write_parquet(path)
    content = path.read_bytes()
    failed = 0
    for place in np.random.default_rng(4).integers(0, 8 * len(content), 200).tolist():
        flipped = bytearray(content)
        flipped[place // 8] ^= 1 << place % 8
        path.write_bytes(flipped)
        try:
            read_quietly(path)
        except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError):
            failed += 1
    assert failed > 10
    assert capfd.readouterr().err == ""


TABLE = {"note": "snow", "rows": [{"seed": k, "att_s": 100.5 + k, "by": (1, 2)} for k in range(5)]}


@pytest.mark.parametrize("indent", [None, 1])
def test_no_flipped_bit_of_a_json_table_is_read_as_other_data(indent: int | None) -> None:
    whole = json.dumps(with_hashes(TABLE, "rows"), indent=indent).encode()
    stored = json.loads(whole)
    assert json_damage(stored, "rows") == ""
    for place in range(8 * len(whole)):
        flipped = bytearray(whole)
        flipped[place // 8] ^= 1 << place % 8
        try:
            found = json.loads(flipped)
            damaged = json_damage(found, "rows")
        except (ValueError, KeyError, TypeError):
            continue
        del found[next(key for key in found if key not in TABLE)]
        same = found == {key: value for key, value in stored.items() if key in TABLE}
        assert same or damaged, flipped


def test_the_damaged_row_of_a_json_table_is_named() -> None:
    table = with_hashes(TABLE, "rows")
    table["rows"][3]["att_s"] += 1
    assert json_damage(table, "rows").startswith("row 3 of rows is not what was written")
    table = with_hashes(TABLE, "rows")
    table["rows"].pop()
    assert json_damage(table, "rows").startswith("it has 4 rows, and had 5")
    table = {**with_hashes(TABLE, "rows"), "note": "rain"}
    assert json_damage(table, "rows").startswith("what stands beside its rows")
    del table["row_hashes"]
    assert json_damage(table, "rows") == ""


def test_threads_that_read_leave_the_standard_error_alone(tmp_path: Path) -> None:
    write_hashed(every_kind(50), tmp_path / "t.parquet")
    before = os.fstat(2)
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda _: read_quietly(tmp_path / "t.parquet"), range(100)))
    assert os.path.samestat(before, os.fstat(2))


def test_a_long_table_of_a_quiet_street_is_read(tmp_path: Path) -> None:
    path, rows = tmp_path / "lanes.parquet", 1_200_000
    write_hashed(pl.DataFrame({"vehicles": np.zeros(rows), "halting": np.zeros(rows)}), path)
    assert path.stat().st_size < rows
    assert read_quietly(path)[0].height == rows


@pytest.mark.parametrize("tables", [{"a.csv": 1}, {"a.csv": {"rows": 1}}, []])
def test_hashes_of_another_form_are_damaged(tables: object, tmp_path: Path) -> None:
    path = csv_of(tmp_path, 3)
    hashes = {"tables": tables, "hash": row_hashes._hash(tables)}
    (tmp_path / CSV_HASHES).write_text(json.dumps(hashes))
    assert "the hashes beside it are" in csv_fault(path)


def test_groups_of_hashes_are_a_list(tmp_path: Path) -> None:
    frame, path = pl.DataFrame({"a": [1]}), tmp_path / "a.parquet"
    text = json.dumps({"rows": 1, "head": row_hashes._head(frame, {}), "groups": 5})
    frame.write_parquet(path, metadata=dict.fromkeys(HASH_KEYS, text))
    assert row_hashes.damage(*read_quietly(path)) == "its hashes are damaged"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="folders are not locked on Windows")
def test_two_writers_of_one_folder_wait_for_each_other(tmp_path: Path) -> None:
    csv_of(tmp_path, 3)
    with ThreadPoolExecutor(1) as pool:
        with only_writer(tmp_path):
            writing = pool.submit(write_csv, tmp_path / "b.csv", "name\ny\n")
            with pytest.raises(TimeoutError):
                writing.result(0.2)
        writing.result(10)
    assert csv_fault(tmp_path / "a.csv") == csv_fault(tmp_path / "b.csv") == ""
