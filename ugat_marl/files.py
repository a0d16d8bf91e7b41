"""Files that are whole or absent, and XML that cannot do anything but be read.

Everything the suite writes goes through `write_whole`: a killed run leaves the old file or the new
one, never half of either. Everything it reads as XML goes through `parse_xml`, which refuses
entities and document types.
"""

from __future__ import annotations

import contextlib
import gzip
import os
import tempfile
import xml.etree.ElementTree as ET
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple
from xml.parsers import expat

from ugat_marl.errors import OutputError, ScenarioError

_PIECE = 1 << 20


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a temporary path beside `path`; it replaces `path` if the block ends normally."""
    require_writable(path)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def require_writable(path: Path) -> None:
    """Refuses a path that cannot become a file; makes the folder it lies in.

    Raises:
        OutputError: It is a folder, or its own folder cannot be made or written to.
    """
    if path.is_dir() or not path.name:
        raise OutputError(f"{str(path)!r} is a folder; give the name of a file")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror}); give another place"
        ) from None


def write_whole(path: Path, content: bytes | str) -> None:
    """Writes `content` to `path` so that a reader sees the old file or the new one."""
    with replacing(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


def user_cache(name: str) -> Path:
    """Where results of the kind `name` are remembered between runs: the user's cache folder."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "ugat_marl" / name


def read_bytes(path: Path) -> bytes:
    """The content of `path`, unpacked if its name ends in ``.gz``.

    Raises:
        ScenarioError: The file is missing, unreadable or a broken archive.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ScenarioError(f"{path}: no such file") from None
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None
    if path.suffix != ".gz":
        return data
    try:
        if not data:
            raise EOFError("it is empty")
        return gzip.decompress(data)
    except (OSError, EOFError, zlib.error) as error:
        raise ScenarioError(
            f"{path}: not a whole gzip archive ({error}); it may have been cut short"
        ) from None


class Tag(NamedTuple):
    """The start of an element of a long XML document.

    Attributes:
        name: Its tag.
        attributes: Its attributes.
        line: Where it stands, from 1.
    """

    name: str
    attributes: dict[str, str]
    line: int


def chunks_of(path: Path) -> Iterator[bytes]:
    """The content of `path` piece by piece, unpacked if its name ends in ``.gz``.

    Raises:
        ScenarioError: As for `read_bytes`.
    """
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            while piece := file.read(_PIECE):
                yield piece
    except FileNotFoundError:
        raise ScenarioError(f"{path}: no such file") from None
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise ScenarioError(
            f"{path}: not a whole gzip archive ({error}); it may have been cut short"
        ) from None
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None


def scan_xml(pieces: Iterable[bytes], name: str) -> Iterator[Tag]:
    """The elements of a document of any length, each at its start, in little memory.

    Args:
        pieces: The document, cut anywhere.
        name: What to call it in errors, usually its path.

    Raises:
        ScenarioError: As for `parse_xml`.
    """
    parser = _refusing_parser(name)
    found: list[Tag] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        found.append(Tag(tag, attributes, parser.CurrentLineNumber))

    parser.StartElementHandler = start
    for piece in pieces:
        _parse(parser, piece, False, name)
        yield from found
        found.clear()
    _parse(parser, b"", True, name)
    yield from found


def parse_xml(content: bytes, name: str) -> ET.Element:
    """Parses XML without document types or entities.

    Args:
        content: The document.
        name: What to call it in errors, usually its path.

    Raises:
        ScenarioError: Not well-formed (a truncated file, say), or declares a document type.
    """
    builder = ET.TreeBuilder()
    parser = _refusing_parser(name)
    parser.buffer_text = True

    def start(tag: str, attributes: dict[str, str]) -> None:
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        builder.end(tag)

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = builder.data
    _parse(parser, content, True, name)
    return builder.close()


def _refusing_parser(name: str) -> expat.XMLParserType:
    parser = expat.ParserCreate()

    def refuse(*_: object) -> None:
        raise ScenarioError(
            f"{name}: document types and entities are not accepted; remove them "
            f"(line {parser.CurrentLineNumber})"
        )

    parser.StartDoctypeDeclHandler = refuse
    parser.EntityDeclHandler = refuse
    return parser


def _parse(parser: expat.XMLParserType, content: bytes, last: bool, name: str) -> None:
    try:
        parser.Parse(content, last)
    except expat.ExpatError as error:
        raise ScenarioError(
            f"{name}: not well-formed XML ({error}); the file may have been cut short"
        ) from None
    except (ValueError, LookupError) as error:
        raise ScenarioError(f"{name}: cannot be decoded: {error}") from None


def xml_bytes(root: ET.Element) -> bytes:
    """Serialises an element tree as an indented UTF-8 document."""
    ET.indent(root, "    ")
    return ET.tostring(root, encoding="UTF-8", xml_declaration=True) + b"\n"
