"""OpenStreetMap's packed form (``.osm.pbf``) turned into XML, which netconvert reads.

The format is that of wiki.openstreetmap.org/wiki/PBF_Format: blobs of protocol buffers, packed with
zlib. Only what a road network needs is kept: nodes, ways, relations and their tags.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO
from xml.sax.saxutils import quoteattr

from ugat_marl.errors import ScenarioError
from ugat_marl.progress import Reporter

_MOST_HEADER, _MOST_BLOB = 64 << 10, 32 << 20
"""Limits of the format itself."""

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_MEMBERS = ("node", "way", "relation")

Fields = dict[int, list[int | bytes]]


def pbf_to_xml(path: Path, out: Path, reporter: Reporter) -> None:
    """Unpacks an extract.

    Args:
        path: The ``.pbf``.
        out: The ``.osm`` to write.
        reporter: Shows progress.

    Raises:
        ScenarioError: Not such a file, cut short, or packed in a way other than zlib.
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as file, out.open("w", encoding="utf-8") as xml:
            xml.write("<?xml version='1.0' encoding='UTF-8'?>\n<osm version=\"0.6\">\n")
            with reporter.task(f"unpacking {path.name}, MiB", max(size >> 20, 1)) as advance:
                done = 0
                for kind, content in _blobs(file, path):
                    if kind == b"OSMData":
                        xml.writelines(_elements(content))
                    while done < file.tell() >> 20:
                        done += 1
                        advance()
            xml.write("</osm>\n")
    except FileNotFoundError:
        raise ScenarioError(f"{path}: no such file") from None
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None
    except (IndexError, KeyError, TypeError, ValueError, struct.error, zlib.error) as error:
        raise ScenarioError(f"{path}: not an OpenStreetMap .pbf, or damaged ({error})") from None


def _blobs(file: BinaryIO, path: Path) -> Iterator[tuple[bytes, bytes]]:
    """Type and unpacked content of every blob."""
    while head := file.read(4):
        (length,) = struct.unpack(">I", head)
        if length > _MOST_HEADER:
            raise ValueError(f"a header of {length} bytes")
        header = _fields(_exactly(file, length))
        size = _int(header[3][0])
        if size > _MOST_BLOB:
            raise ValueError(f"a blob of {size} bytes")
        blob = _fields(_exactly(file, size))
        if 1 in blob:
            content = _bytes(blob[1][0])
        elif 3 in blob:
            unpacker = zlib.decompressobj()
            content = unpacker.decompress(_bytes(blob[3][0]), _MOST_BLOB)
            if unpacker.unconsumed_tail:
                raise ValueError("a blob that unpacks to more than the format allows")
        else:
            raise ScenarioError(
                f"{path}: packed in another way than zlib; convert it with: osmium cat "
                f"{path.name} -o extract.osm.gz"
            )
        yield _bytes(header[1][0]), content


def _exactly(file: BinaryIO, length: int) -> bytes:
    content = file.read(length)
    if len(content) < length:
        raise ValueError("cut short")
    return content


def _elements(content: bytes) -> Iterator[str]:
    """The nodes, ways and relations of one block, as lines of XML."""
    block = _fields(content)
    texts = [quoteattr(_bytes(item).decode()) for item in _fields(_bytes(block[1][0])).get(1, [])]
    scale = _int(block.get(17, [100])[0]) * 1e-9
    south, west = (_signed(_int(block.get(key, [0])[0])) * 1e-9 for key in (19, 20))
    place = (scale, south, west)
    for group in block.get(2, []):
        parts = _fields(_bytes(group))
        for item in parts.get(1, []):
            yield _node(_fields(_bytes(item)), texts, place)
        for item in parts.get(2, []):
            yield from _dense(_fields(_bytes(item)), texts, place)
        for item in parts.get(3, []):
            yield _way(_fields(_bytes(item)), texts)
        for item in parts.get(4, []):
            yield _relation(_fields(_bytes(item)), texts)


Place = tuple[float, float, float]


def _node(item: Fields, texts: Sequence[str], place: Place) -> str:
    lat, lon = (_zigzag(_int(item[key][0])) for key in (8, 9))
    return _placed(_zigzag(_int(item[1][0])), lat, lon, place, _tags(item, texts))


def _dense(item: Fields, texts: Sequence[str], place: Place) -> Iterator[str]:
    """Nodes as differences from one to the next; their tags stand in one list, 0 ends a node's."""
    keys = iter(_packed(item.get(10, [])))
    ident = lat = lon = 0
    columns = (_packed(item.get(key, [])) for key in (1, 8, 9))
    for a, b, c in zip(*columns, strict=True):
        ident, lat, lon = ident + _zigzag(a), lat + _zigzag(b), lon + _zigzag(c)
        tags = ""
        while key := next(keys, 0):
            tags += f"<tag k={texts[key]} v={texts[next(keys)]}/>"
        yield _placed(ident, lat, lon, place, tags)


def _placed(ident: int, lat: int, lon: int, place: Place, tags: str) -> str:
    scale, south, west = place
    return (
        f'<node id="{ident}" lat="{south + scale * lat:.7f}" lon="{west + scale * lon:.7f}" '
        f'version="1">{tags}</node>\n'
    )


def _way(item: Fields, texts: Sequence[str]) -> str:
    ref, refs = 0, ""
    for step in _packed(item.get(8, [])):
        ref += _zigzag(step)
        refs += f'<nd ref="{ref}"/>'
    return f'<way id="{_int(item[1][0])}" version="1">{refs}{_tags(item, texts)}</way>\n'


def _relation(item: Fields, texts: Sequence[str]) -> str:
    ref, members = 0, ""
    columns = (_packed(item.get(key, [])) for key in (8, 9, 10))
    for role, step, kind in zip(*columns, strict=True):
        ref += _zigzag(step)
        members += f'<member type="{_MEMBERS[kind]}" ref="{ref}" role={texts[role]}/>'
    head = f'<relation id="{_int(item[1][0])}" version="1">'
    return f"{head}{members}{_tags(item, texts)}</relation>\n"


def _tags(item: Fields, texts: Sequence[str]) -> str:
    pairs = zip(_packed(item.get(2, [])), _packed(item.get(3, [])), strict=True)
    return "".join(f"<tag k={texts[key]} v={texts[value]}/>" for key, value in pairs)


def _fields(content: bytes) -> Fields:
    """A message of protocol buffers: its values by the number of their field."""
    found: Fields = {}
    place, end = 0, len(content)
    while place < end:
        key, place = _varint(content, place)
        kind = key & 7
        value: int | bytes
        if kind == _VARINT:
            value, place = _varint(content, place)
        elif kind == _BYTES:
            length, place = _varint(content, place)
            value, place = content[place : place + length], place + length
        elif kind in (_FIXED64, _FIXED32):
            length = 8 if kind == _FIXED64 else 4
            value, place = content[place : place + length], place + length
        else:
            raise ValueError(f"a field of kind {kind}")
        if place > end:
            raise ValueError("cut short")
        found.setdefault(key >> 3, []).append(value)
    return found


def _packed(values: Sequence[int | bytes]) -> list[int]:
    found: list[int] = []
    for value in values:
        if isinstance(value, int):
            found.append(value)
            continue
        place = 0
        while place < len(value):
            number, place = _varint(value, place)
            found.append(number)
    return found


def _varint(content: bytes, place: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = content[place]
        place += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, place
        shift += 7
        if shift > 63:
            raise ValueError("a number of more than ten bytes")


def _zigzag(value: int) -> int:
    return (value >> 1) ^ -(value & 1)


def _signed(value: int) -> int:
    return value - (1 << 64) if value >> 63 else value


def _int(value: int | bytes) -> int:
    if isinstance(value, bytes):
        raise TypeError("bytes where a number belongs")
    return value


def _bytes(value: int | bytes) -> bytes:
    if isinstance(value, int):
        raise TypeError("a number where bytes belong")
    return value
