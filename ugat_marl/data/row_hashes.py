"""Hashes of the rows of a Parquet file, because Parquet itself reads flipped bits as other numbers.

A file of `write_hashed` carries one hash per row group, over the values and not over the bytes of
the file, so that it does not depend on compression or on the version of a library. The hashes are
there twice: one flipped bit in their name would otherwise hide them.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path

import polars as pl

HASH_KEYS = ("ugat_marl.row_hashes", "ugat_marl.row_hashes.copy")
"""Keys of the hashes in the metadata of the file."""

_GROUP_ROWS = 65536
"""Rows of a row group. Half as many name the damage more closely and make the file longer."""


def write_hashed(
    frame: pl.DataFrame, path: Path, metadata: Mapping[str, str] | None = None
) -> None:
    """Write a table as Parquet with the hashes of its rows.

    Args:
        frame: The table.
        path: File to write; the caller makes it whole or absent.
        metadata: Further metadata of the file; the hashes cover it too.
    """
    own = dict(metadata or {})
    text = json.dumps(
        {"rows": frame.height, "head": _head(frame, own), "groups": [*_groups(frame)]}
    )
    frame.write_parquet(
        path, metadata={**own, **dict.fromkeys(HASH_KEYS, text)}, row_group_size=_GROUP_ROWS
    )


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
        stored = json.loads(texts[0] or "")
        rows, head, groups = stored["rows"], stored["head"], stored["groups"]
    except (ValueError, KeyError, TypeError):
        return "its hashes are damaged"
    if texts[0] != texts[1]:
        return "its hashes are damaged"
    if rows != frame.height:
        return f"it has {frame.height} rows, and had {rows} when it was written"
    if head != _head(frame, {key: metadata[key] for key in own if key in metadata}):
        return "its columns or its metadata are not those that were written"
    for number, (was, now) in enumerate(zip(groups, _groups(frame), strict=False)):
        if was != now:
            first, last = number * _GROUP_ROWS, min((number + 1) * _GROUP_ROWS, rows) - 1
            return f"row group {number} (rows {first} to {last}) is not what was written"
    return ""


def is_hashed(metadata: Mapping[str, str]) -> bool:
    """Return True if a file carries hashes, damaged or not."""
    return any(key in metadata for key in HASH_KEYS)


def _head(frame: pl.DataFrame, metadata: Mapping[str, str]) -> str:
    names = [[name, str(kind)] for name, kind in frame.schema.items()]
    text = json.dumps([names, sorted(metadata.items())])
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _groups(frame: pl.DataFrame) -> Iterator[str]:
    """Yield the hash of each row group."""
    for start in range(0, frame.height, _GROUP_ROWS):
        digest = hashlib.blake2b(digest_size=16)
        for column in frame.slice(start, _GROUP_ROWS):
            for piece in _bytes(column):
                digest.update(len(piece).to_bytes(8, "little"))
                digest.update(piece)
        yield digest.hexdigest()


def _bytes(column: pl.Series) -> Iterator[bytes]:
    """Yield the values of a column in a form that depends on nothing else."""
    yield column.is_null().to_numpy().tobytes()
    kind = column.dtype
    if isinstance(kind, pl.Array):
        column, kind = column.arr.to_list(), pl.List(kind.inner)
    if isinstance(kind, pl.List):
        yield column.list.len().fill_null(0).cast(pl.UInt32).to_numpy().tobytes()
        filled = column.filter(column.list.len() > 0)
        yield from _bytes(filled.explode(empty_as_null=True))
    elif isinstance(kind, pl.Struct):
        for part in column.struct.fields:
            yield from _bytes(column.struct.field(part))
    elif isinstance(kind, pl.String | pl.Categorical | pl.Enum):
        texts = column.cast(pl.String).fill_null("")
        yield texts.str.len_bytes().to_numpy().tobytes()
        yield "".join(texts).encode()
    elif isinstance(kind, pl.Boolean):
        yield column.fill_null(value=False).cast(pl.UInt8).to_numpy().tobytes()
    else:
        yield column.to_physical().fill_null(0).to_numpy().tobytes()
