"""Hashes of the rows of tables, because a flipped bit often reads as another number.

A Parquet file of `write_hashed` carries one hash per row group, over the values and not over the
bytes of the file, so that it does not depend on compression or on the version of a library. The
hashes are there twice: one flipped bit in their name would otherwise hide them.

CSV has no place for hashes that other programs would not read as a row. Those of `write_csv_hashes`
stand in a file beside the tables. A table that is not listed there, such as one made by hand, has
none.

A table in JSON holds its hashes itself, see `with_hashes`.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import itertools
import json
import os
import re
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import polars as pl

from ugat_marl.errors import CheckpointError
from ugat_marl.files import (
    MALFORMED,
    only_writer,
    parse_json,
    read_json,
    require_writable,
    write_whole,
)

HASH_KEYS = ("ugat_marl.row_hashes", "ugat_marl.row_hashes.copy")
"""Keys of the hashes in the metadata of the file."""

JSON_HASHES = "row_hashes"
"""Key of the hashes in a table in JSON."""

CSV_HASHES = "row-hashes.json"
"""Name of the file with the hashes of the CSV tables in its folder."""

UNREADABLE = (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError)
"""Errors that polars raises for a file that is missing, damaged, or no table."""

_MAGIC = b"PAR1"
"""First and last bytes of a Parquet file."""
_LEAST_PARQUET = 12
"""Bytes of the shortest Parquet file: both magic numbers, and the length of the footer."""
_GROUP_ROWS = 65536
"""Rows of a row group. Half as many name the damage more closely and make the file longer."""
_FEW_CELLS = 100_000_000
"""Cells that are read whatever the size of their file: 1 GB. Twice as many may fill a laptop."""
_NESTED_CELLS = 100
"""Numbers that a cell with a list or an array is taken to hold."""
_MOST_CSV_GROUPS = 1024
"""Most hashes of a CSV table. Twice as many name the damage more closely and double their file."""


def write_hashed(
    frame: pl.DataFrame, path: Path, metadata: Mapping[str, str] | None = None
) -> None:
    """Write a table as Parquet with the hashes of its rows.

    Args:
        frame: The table.
        path: File to write; the caller makes it whole or absent.
        metadata: Further metadata of the file; the hashes cover it too.

    Raises:
        OSError: The file cannot be written, such as for want of room.
    """
    own = dict(metadata or {})
    text = json.dumps(
        {"rows": frame.height, "head": _head(frame, own), "groups": [*_groups(frame, _GROUP_ROWS)]}
    )
    told = {**own, **dict.fromkeys(HASH_KEYS, text)}
    try:
        frame.write_parquet(path, metadata=told, row_group_size=_GROUP_ROWS)
    except pl.exceptions.ComputeError as error:
        # polars names some errors of the system in its text alone
        if (number := re.search(r"\(os error (\d+)\)", str(error))) is None:
            raise
        raise OSError(int(number[1]), os.strerror(int(number[1]))) from None


def write_csv_hashes(directory: Path, names: Iterable[str]) -> None:
    """Write the hashes of the rows of CSV files, which are there already, into `CSV_HASHES`.

    Args:
        directory: Folder of the files.
        names: Names of the files; those of other files stay in the list.
    """
    with only_writer(directory):
        _add_csv_hashes(directory, names)


def _add_csv_hashes(directory: Path, names: Iterable[str]) -> None:
    tables = _known_csv_hashes(directory)
    for name in names:
        frame = csv_texts((directory / name).read_bytes())
        rows = _rows_of_csv_group(frame.height)
        tables[name] = {
            "rows": frame.height, "head": _head(frame, {}), "groups": [*_groups(frame, rows)],
        }  # fmt: skip
    _store_csv_hashes(directory, tables)


def write_csv(path: Path, text: str | Callable[[], str]) -> None:
    """Write a CSV table atomically, and the hashes of its rows beside it.

    A run that is killed between the two leaves a table without hashes.

    Args:
        path: The file.
        text: The table, or a function that makes it from the one there, which is called when no
            other call can change that any more.
    """
    require_writable(path)
    with only_writer(path.parent):
        made = text if isinstance(text, str) else text()  # it can check the table by its hashes
        tables = _known_csv_hashes(path.parent)
        if tables.pop(path.name, None) is not None:
            _store_csv_hashes(path.parent, tables)
        write_whole(path, made)
        _add_csv_hashes(path.parent, [path.name])


def with_hashes(content: Mapping[str, Any], rows: str) -> dict[str, Any]:
    """Return values for JSON with the hashes of their rows, and one of everything else.

    Args:
        content: The values.
        rows: Key of the list of rows among them.
    """
    plain = json.loads(json.dumps(content))  # as they are when they are read
    return {**plain, JSON_HASHES: _json_hashes(plain, rows)}


def json_damage(content: Mapping[str, Any], rows: str) -> str:
    """Return what is damaged in values of `with_hashes`; empty if they are whole or have no hashes.

    Args:
        content: The values.
        rows: Key of the list of rows among them.

    Returns:
        The damage as words that follow the name of the file, with the way out.

    Raises:
        TypeError: The values have another form.
        KeyError: There are no rows.
    """
    if JSON_HASHES not in content:
        return ""
    stored, now = content[JSON_HASHES], _json_hashes(content, rows)
    if stored == now:
        return ""
    way_out = f"copy it again, or remove {JSON_HASHES} from it if you changed it yourself"
    was = stored[rows]
    for number, (one, other) in enumerate(zip(was, now[rows], strict=False)):
        if one != other:
            return f"row {number} of {rows} is not what was written; {way_out}"
    if len(was) != len(now[rows]):
        return f"it has {len(now[rows])} rows, and had {len(was)} when written; {way_out}"
    return f"what stands beside its rows is not what was written; {way_out}"


def _json_hashes(content: Mapping[str, Any], rows: str) -> dict[str, Any]:
    rest = {key: value for key, value in content.items() if key not in (rows, JSON_HASHES)}
    return {"rest": _hash(rest), rows: [_hash(row) for row in content[rows]]}


def csv_texts(content: bytes, separator: str = ",") -> pl.DataFrame:
    """Return the cells of a CSV file as text.

    Args:
        content: The file.
        separator: What stands between the cells.

    Raises:
        polars.exceptions.PolarsError: The content is not a table.
    """
    return pl.read_csv(io.BytesIO(content), separator=separator, infer_schema=False)


def csv_damage(path: Path, frame: pl.DataFrame) -> str:
    """Return what is damaged in a CSV table that was read; empty if it is whole or has no hashes.

    Args:
        path: The file.
        frame: Its cells, from `csv_texts`.

    Returns:
        The damage as words that follow the name of the file, with the way out.
    """
    if not (path.parent / CSV_HASHES).exists():
        return ""
    try:
        tables = _csv_hashes(path.parent / CSV_HASHES)
    except CheckpointError as error:
        return f"or the hashes beside it are ({error}); copy both again, or remove {CSV_HASHES}"
    if path.name not in tables:
        return ""
    stored = tables[path.name]
    way_out = f"copy it again, or remove {CSV_HASHES} if you changed it yourself"
    if stored["head"] != _head(frame, {}):
        return f"its columns are not those that were written; {way_out}"
    rows = _rows_of_csv_group(stored["rows"])
    now = [*_groups(frame, rows)]
    for number, was in enumerate(stored["groups"]):
        if now[number : number + 1] != [was]:
            first = number * rows + 1
            last = min(first + rows - 1, stored["rows"])
            several = f"rows {first} to {last} behind the header are"
            which = f"row {first} behind the header is" if first == last else several
            return f"{which} not what was written; {way_out}"
    if frame.height != stored["rows"]:
        return f"it has {frame.height} rows, and had {stored['rows']} when written; {way_out}"
    return ""


def is_csv_as_written(path: Path) -> bool:
    """Return True if a CSV table has hashes beside it and is what was written.

    Raises:
        OSError: The file cannot be read.
        polars.exceptions.PolarsError: The file is not a table.
    """
    if path.name not in _known_csv_hashes(path.parent):
        return False
    return not csv_damage(path, csv_texts(path.read_bytes()))


def is_parquet_as_written(path: Path) -> bool:
    """Return True if a Parquet table holds hashes and is what was written.

    Raises:
        OSError: The file cannot be read.
        polars.exceptions.PolarsError: The file is not a table.
    """
    frame, metadata = read_quietly(path)
    return is_hashed(metadata) and not damage(frame, metadata)


def _known_csv_hashes(directory: Path) -> dict[str, Any]:
    file = directory / CSV_HASHES
    try:
        return _csv_hashes(file) if file.exists() else {}
    except CheckpointError:  # damaged; the tables written next have hashes again
        return {}


def _store_csv_hashes(directory: Path, tables: Mapping[str, Any]) -> None:
    content = {"tables": tables, "hash": _hash(tables)}
    write_whole(directory / CSV_HASHES, json.dumps(content, indent=1, sort_keys=True) + "\n")


def _csv_hashes(file: Path) -> dict[str, Any]:
    content = read_json(file, CheckpointError)
    try:
        tables = content["tables"]
        whole = content["hash"] == _hash(tables)
        for table in tables.values():
            whole &= _have_form(table["rows"], table["head"], table["groups"])
    except MALFORMED:
        whole, tables = False, {}
    if not whole:
        raise CheckpointError(f"{file}: not what was written")
    return tables


def _have_form(rows: Any, head: Any, groups: Any) -> bool:
    """Return True if values from a file can be the hashes of a table; anybody can write some."""
    return type(rows) is int and rows >= 0 and isinstance(head, str) and isinstance(groups, list)


def _rows_of_csv_group(rows: int) -> int:
    """Return the rows per hash: one in a short table, so that a damaged row is named."""
    return -(-rows // _MOST_CSV_GROUPS) or 1


def _hash(content: Any) -> str:
    text = json.dumps(content, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def half_parquet(file: BinaryIO) -> str:
    """Return what shows that a file is no whole Parquet file; "" if it has both magic numbers.

    Args:
        file: The file, at its start.

    Returns:
        The fault as words that follow the name of the file.
    """
    head = file.read(4)
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - 4))
    if head != _MAGIC:
        return "not a Parquet file"
    if file.read() != _MAGIC or size < _LEAST_PARQUET:
        return f"the Parquet file is cut short ({size} bytes, no footer)"
    return ""


def read_quietly(
    source: Path | io.BytesIO, *, nested: bool = True
) -> tuple[pl.DataFrame, dict[str, str]]:
    """Return the table and the metadata of a Parquet file; a damaged one prints nothing.

    Threads of polars print their own stack traces before they raise the error in Python.

    Args:
        source: The file, or its content.
        nested: False to refuse columns of lists, one of which may hold more than the memory.

    Raises:
        polars.exceptions.PolarsError: The file is damaged, or has more rows than bytes; also the
            other errors of `UNREADABLE`.
    """
    with _ONE_AT_A_TIME, _without_standard_error():
        _refuse_what_fills_memory(source, nested=nested)
        frame = pl.read_parquet(_again(source))
        return frame, pl.read_parquet_metadata(_again(source))


def _refuse_what_fills_memory(source: Path | io.BytesIO, *, nested: bool) -> None:
    """Refuse a small file of very many equal rows, and columns of lists if `nested` is False.

    Only the footer is read. Equal rows take next to no space. So do those of a quiet street, but
    they are not that many.
    """
    size = source.stat().st_size if isinstance(source, Path) else len(source.getbuffer())
    table = pl.scan_parquet(_again(source))
    schema = table.collect_schema()
    for name, kind in schema.items():
        if kind.is_nested() and not nested:
            raise pl.exceptions.SchemaError(f"column {name!r} holds lists ({kind})")
    cells = sum(_NESTED_CELLS if kind.is_nested() else 1 for kind in schema.dtypes())
    rows = table.select(pl.len()).collect().item()
    if rows > size and rows * cells > _FEW_CELLS:
        raise pl.exceptions.ComputeError(f"{rows} rows in {size} bytes")


def _again(source: Path | io.BytesIO) -> Path | io.BytesIO:
    """Return the source, at its start if it is a stream."""
    if isinstance(source, io.BytesIO):
        source.seek(0)
    return source


_ONE_AT_A_TIME = threading.Lock()
"""A process has one standard error, and threads may read tables at the same time."""


@contextlib.contextmanager
def _without_standard_error() -> Iterator[None]:
    """Drop the standard error of a block if the block fails."""
    sys.stderr.flush()
    try:
        said = tempfile.TemporaryFile()  # noqa: SIM115 - closed below
        kept = os.dup(2)
    except OSError:  # no place for what is said, or no standard error at all
        yield
        return
    with said:
        try:
            os.dup2(said.fileno(), 2)
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        said.seek(0)
        os.write(2, said.read())


def damage(frame: pl.DataFrame, metadata: Mapping[str, str], own: tuple[str, ...] = ()) -> str:
    """Return what is damaged in a table that was read; empty if it is whole.

    Args:
        frame: The table.
        metadata: Metadata of its file.
        own: Keys of the metadata that were given to `write_hashed`.

    Returns:
        The damage as words that follow the name of the file. A file without hashes has none here;
        `is_hashed` tells those apart.
    """
    if not is_hashed(metadata):
        return ""
    texts = [metadata.get(key) for key in HASH_KEYS]
    try:
        stored = parse_json(texts[0] or "", "hashes", CheckpointError)
        rows, head, groups = stored["rows"], stored["head"], stored["groups"]
    except (CheckpointError, *MALFORMED):
        return "its hashes are damaged"
    if texts[0] != texts[1] or not _have_form(rows, head, groups):
        return "its hashes are damaged"
    if rows != frame.height:
        return f"it has {frame.height} rows, and had {rows} when it was written"
    if head != _head(frame, {key: metadata[key] for key in own if key in metadata}):
        return "its columns or its metadata are not those that were written"
    try:
        for number, (was, now) in enumerate(zip(groups, _groups(frame, _GROUP_ROWS), strict=False)):
            if was != now:
                first, last = number * _GROUP_ROWS, min((number + 1) * _GROUP_ROWS, rows) - 1
                return f"row group {number} (rows {first} to {last}) is not what was written"
    except pl.exceptions.PolarsError:
        return "a column has a type that no table of the suite has"
    return ""


def is_hashed(metadata: Mapping[str, str]) -> bool:
    """Return True if a file carries hashes, damaged or not."""
    return any(key in metadata for key in HASH_KEYS)


def _head(frame: pl.DataFrame, metadata: Mapping[str, str]) -> str:
    names = [[name, str(kind)] for name, kind in frame.schema.items()]
    return _hash([names, sorted(metadata.items())])


def _groups(frame: pl.DataFrame, rows: int) -> Iterator[str]:
    """Yield the hash of each group of rows."""
    many = max(_GROUP_ROWS // rows, 1) * rows  # polars takes as long for one row as for a thousand
    for start in range(0, frame.height, many):
        columns = [_pieces(column, rows) for column in frame.slice(start, many)]
        for group in zip(*columns, strict=True):
            digest = hashlib.blake2b(digest_size=16)
            for piece in itertools.chain.from_iterable(group):
                digest.update(len(piece).to_bytes(8, "little"))
                digest.update(piece)
            yield digest.hexdigest()


def _pieces(column: pl.Series, rows: int) -> list[list[bytes]]:
    """Return `_bytes` of each group of rows."""
    if isinstance(column.dtype, pl.String):
        return _texts(column, rows)
    return [[*_bytes(column.slice(start, rows))] for start in range(0, len(column), rows)]


def _texts(column: pl.Series, rows: int) -> list[list[bytes]]:
    """Return `_bytes` of each group of rows of a column of texts; of one without rows, one."""
    none, texts = column.is_null().to_numpy(), column.fill_null("")
    lengths, listed = texts.str.len_bytes().to_numpy(), texts.to_list()
    return [
        [none[k : k + rows].tobytes(), lengths[k : k + rows].tobytes(),
         "".join(listed[k : k + rows]).encode()]
        for k in range(0, max(len(column), 1), rows)
    ]  # fmt: skip


def _bytes(column: pl.Series) -> Iterator[bytes]:
    """Yield the values of a column in a form that depends on nothing else."""
    kind = column.dtype
    if isinstance(kind, pl.String | pl.Categorical | pl.Enum):
        (pieces,) = _texts(column.cast(pl.String), max(len(column), 1))
        yield from pieces
        return
    yield column.is_null().to_numpy().tobytes()
    if isinstance(kind, pl.Array):
        column, kind = column.arr.to_list(), pl.List(kind.inner)
    if isinstance(kind, pl.List):
        yield column.list.len().fill_null(0).cast(pl.UInt32).to_numpy().tobytes()
        filled = column.filter(column.list.len() > 0)
        yield from _bytes(filled.explode(empty_as_null=True))
    elif isinstance(kind, pl.Struct):
        for part in column.struct.fields:
            yield from _bytes(column.struct.field(part))
    elif isinstance(kind, pl.Boolean):
        yield column.fill_null(value=False).cast(pl.UInt8).to_numpy().tobytes()
    else:
        yield column.to_physical().fill_null(0).to_numpy().tobytes()
