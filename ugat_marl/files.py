"""Files that are whole or absent, and safe reading of XML, JSON and TOML.

The suite writes files with `replacing` or `write_whole`: a killed run leaves the old file or the
new one, never half of either. It reads XML with one parser, which refuses entities and document
types.
"""

from __future__ import annotations

import contextlib
import errno
import gzip
import hashlib
import importlib.util
import io
import json
import math
import os
import re
import secrets
import shutil
import stat
import tempfile
import tomllib
import weakref
import xml.etree.ElementTree as ET
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from xml.parsers import expat

from ugat_marl.errors import CheckpointError, OptionError, OutputError, ScenarioError, UgatMarlError
from ugat_marl.progress import Reporter, Silent, usual, watched

_PIECE = 1 << 20
_KEPT = 8 << 20
"""Bytes of an edited document above which it is kept in a file instead of in memory."""
_INDENT = "    "
_BEGINS_ROW = re.compile(rf"\n{_INDENT}(?=<[^/])")
"""Where a child begins in a document that `DocumentDraft` wrote."""
_UNPACKED = 256 << 20
"""Unpacked bytes from which the ratio of an archive counts."""
_MOST_RATIO = 100
"""Largest ratio of unpacked to packed bytes; XML packs to a tenth or a thirtieth."""
_DEEPEST = 64
"""Most elements inside each other. Files of SUMO and OpenStreetMap have fewer than ten. Deeper ones
exhaust the stack of whatever walks through them."""
_LONGEST = 64 << 20
"""Most bytes of a JSON or TOML file; those of the suite have less than a hundredth of it."""
_LARGEST = 1 << 256
"""Largest integer of a JSON or TOML file. One beyond 2^1024 is not a float; the state of a random
generator has 128 bits."""
_TOO_DEEP = f"more than {_DEEPEST} tables or lists inside each other, which no such file needs"
_TOO_LONG = "a number is far too long, which no such file needs"

MALFORMED = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)
"""Exceptions that parsed data of another form than expected raises where it is taken apart."""

OWN_COUNTERS = "counters.json"
"""Entry that the state of a user's learner has, and no other checkpoint."""

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_SPECIAL = re.compile('[&<>"\\r\\n\\t]')
_IN_TEXT = str.maketrans({"&": "&amp;", "<": "&lt;", ">": "&gt;"})
_IN_ATTRIBUTE = _IN_TEXT | str.maketrans(
    {'"': "&quot;", "\r": "&#13;", "\n": "&#10;", "\t": "&#09;"}
)
"""Characters of XML that stand for others in values of attributes, and in texts."""


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; it replaces `path` if the block ends normally.

    A file that is replaced keeps its rights.
    """
    require_writable(path)
    if path.is_symlink():  # it goes on to point at the file
        path = Path(os.path.realpath(path))
        require_writable(path)
    temporary = path.with_name(f".{secrets.token_hex(8)}.tmp")
    mode = stat.S_IMODE(path.stat().st_mode) if path.exists() else None
    # opened like any new file, so that the system applies the umask
    rights = 0o666 if mode is None else 0o600
    os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, rights))
    try:
        yield temporary
        if mode is not None:
            temporary.chmod(mode)
        temporary.replace(path)
    except OSError as error:
        if error.filename is None and error.errno in _NO_ROOM:  # of a write, which has no name
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def only_writer(directory: Path) -> Iterator[None]:
    """Lock a folder during a block, in which a file there is read and changed.

    Another process waits for it. Nothing is locked where that is not possible: on Windows, and on
    some network drives.
    """
    if os.name == "nt":  # a folder cannot be opened there
        yield
        return
    folder = os.open(directory, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):
            lock(folder, wait=True)
        yield
    finally:
        os.close(folder)


def lock(descriptor: int, *, wait: bool = False) -> None:
    """Lock an open file or folder until it is closed; a killed process frees it. Not on Windows.

    Args:
        descriptor: The file or folder.
        wait: True to wait until another process frees it.

    Raises:
        BlockingIOError: Another process has locked it.
        OSError: It cannot be locked, such as on some network drives.
    """
    if importlib.util.find_spec("fcntl") is None:
        return
    import fcntl

    fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))


_made: ContextVar[list[Path] | None] = ContextVar("made", default=None)
"""Folders made in the block of `without_empty_folders`, those above others first."""


@contextlib.contextmanager
def without_empty_folders() -> Iterator[None]:
    """Remove at the end of a block the folders that it made for files and wrote nothing into."""
    folders: list[Path] = []
    token = _made.set(folders)
    try:
        yield
    finally:
        _made.reset(token)
        for folder in reversed(folders):
            with contextlib.suppress(OSError):  # it holds something
                folder.rmdir()


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, and note which were not there."""
    made = _made.get()
    if made is not None:
        whole = folder.absolute()
        made += [each for each in (*reversed(whole.parents), whole) if not each.exists()]
    folder.mkdir(parents=True, exist_ok=True)


def require_writable(path: Path, suffix: str | None = None) -> None:
    """Refuse a path that cannot become a file, and make its folder.

    Args:
        path: The file to write.
        suffix: Suffix of such files, such as ".json"; None allows every name.

    Raises:
        OutputError: The path is a folder, the name is that of a file of another kind, or the folder
            cannot be made or written to.
    """
    try:
        is_there, is_file, is_folder = path.exists(), path.is_file(), path.is_dir()
    except OSError as error:  # a name that is too long
        raise OutputError(
            f"{str(path)[:80]}: cannot be written ({error.strerror}); give another name"
        ) from None
    if is_folder or not path.name:
        raise OutputError(f"{str(path)!r} is a folder; give the name of a file")
    if is_there and not is_file:
        raise OutputError(f"{path}: is no file, but a device or a pipe; give the name of a file")
    if suffix is not None and path.suffix.lower() != suffix:
        replaced = "; there is a file of this name, and it would be replaced" if is_file else ""
        raise OutputError(
            f"{path}: a {suffix} file is written here{replaced}; give a name that ends in {suffix}"
        )
    try:
        make_folder(path.parent)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror}); give another place"
        ) from None


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file's content, so that the file may be moved.

    Raises:
        OptionError: The file cannot be read.
    """
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise OptionError(f"{path}: {error.strerror}; name a file that can be read") from None


def write_whole(path: Path, content: bytes | str) -> None:
    """Write `content` to `path`. A reader sees either the old file or the whole new one.

    Raises:
        OutputError: The text cannot be written as UTF-8, as names of files in other encodings.
    """
    try:
        content = content.encode() if isinstance(content, str) else content
    except UnicodeEncodeError as error:
        name = error.object[max(0, error.start - 20) : error.end + 20]
        raise OutputError(f"{path}: {name!r} in it is not UTF-8; rename that file") from None
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def put_folder(made: Path, target: Path, before: Path) -> None:
    """Move a finished folder to its place.

    Args:
        made: The finished folder, on the same file system.
        target: Its place.
        before: Where a folder at that place goes; it comes back if the move fails.
    """
    if target.exists():
        target.rename(before)
    try:
        made.rename(target)
    except BaseException:
        if before.exists():
            before.rename(target)
        raise


@contextlib.contextmanager
def scratch() -> Iterator[None]:
    """Context for writing into the folder for temporary files.

    Raises:
        OutputError: That folder is full or missing.
    """
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"{tempfile.gettempdir()}: cannot hold what is made of a long file "
            f"({error.strerror}); make room, or name another folder in TMPDIR"
        ) from None


def with_home(text: str) -> Path:
    """Return the path of `text`, where a leading ``~`` or ``~user`` is the user's home folder.

    It stays as it is where the system knows no such user: it may be the name of a file.
    """
    return Path(os.path.expanduser(text))  # noqa: PTH111 - Path.expanduser raises RuntimeError


def distinct_endings(paths: Iterable[Path]) -> list[str] | None:
    """Return the shortest endings of paths that differ from each other; None if two are equal."""
    parts = [path.parts for path in paths]
    for length in range(1, max(map(len, parts), default=1) + 1):
        endings = ["/".join(path_parts[-length:]) for path_parts in parts]
        if len(set(endings)) == len(endings):
            return endings
    return None


def user_cache(name: str) -> Path:
    """Return the folder in the user's cache that keeps results of the kind `name` between runs.

    Raises:
        OutputError: The user has no home folder.
    """
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(base) if base else Path.home() / ".cache") / "ugat_marl" / name
    except RuntimeError:  # the system does not know the user, as in some containers
        raise OutputError(
            "there is no home folder to keep results in; name a folder in XDG_CACHE_HOME"
        ) from None


def refuse_endless(path: Path, fault: type[UgatMarlError]) -> None:
    """Refuse a pipe or a device, whose reading may never end; a missing file is let through.

    Args:
        path: The file.
        fault: Kind of the error to raise.

    Raises:
        UgatMarlError: As `fault`.
    """
    with contextlib.suppress(OSError):
        mode = path.stat().st_mode
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise fault(f"{path}: is a pipe or a device; copy what it gives into a file")


def read_bytes(path: Path) -> bytes:
    """Return the content of `path`, unpacked if its name ends in ``.gz``.

    Raises:
        ScenarioError: The file is missing, unreadable or a broken archive.
    """
    return b"".join(chunks_of(path))


def _bounded(pieces: Iterator[bytes], path: Path, packed: int) -> Iterator[bytes]:
    """Yield the pieces of an archive; refuse one made to fill memory or disk."""
    total = 0
    for piece in pieces:
        total += len(piece)
        if total > max(_UNPACKED, _MOST_RATIO * packed):
            raise ScenarioError(
                f"{path}: {packed} bytes unpack to more than {_MOST_RATIO} times as many, which no "
                "network or demand does; unpack it yourself if you trust it"
            )
        yield piece


def require_checkpoint(path: Path) -> None:
    """Refuse a checkpoint that is not there, before its content is blamed.

    Raises:
        CheckpointError: There is no such file.
    """
    if not path.is_file():
        raise CheckpointError(f"{path}: no such checkpoint file")


def require_stored(archive: zipfile.ZipFile) -> None:
    """Refuse an archive with packed entries.

    The suite writes none, and a decompression bomb needs them.

    Raises:
        ValueError: An entry is packed.
    """
    for entry in archive.infolist():
        if entry.compress_type != zipfile.ZIP_STORED or entry.file_size > entry.compress_size:
            raise ValueError(f"{entry.filename} is packed, which the suite never does")


def read_toml(path: Path, fault: type[UgatMarlError]) -> dict[str, Any]:
    """Return the content of a TOML file that others may have written.

    Args:
        path: The file.
        fault: Kind of the error to raise.

    Raises:
        UgatMarlError: As `fault`. The file is missing, too long, no TOML in UTF-8 or nested too
            deeply.
    """
    return _read_text(path, fault, tomllib.loads, "TOML")


def read_json(path: Path, fault: type[UgatMarlError]) -> Any:
    """Return the content of a JSON file that others may have written.

    Args:
        path: The file.
        fault: Kind of the error to raise.

    Raises:
        UgatMarlError: As for `read_toml`, with JSON.
    """
    return _read_text(path, fault, json.loads, "JSON")


def json_values(value: Any) -> Any:
    """Return values as JSON has them: lists for tuples, null for nan and infinite numbers."""
    if isinstance(value, Mapping):
        return {key: json_values(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [json_values(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def parse_json(text: str, name: str, fault: type[UgatMarlError]) -> Any:
    """Return the content of a JSON text that others may have written.

    Args:
        text: The text.
        name: Name of the text in errors, usually its path.
        fault: Kind of the error to raise.

    Raises:
        UgatMarlError: As `fault`. The text is no JSON, or nested too deeply.
    """
    return _parsed(text, name, fault, json.loads, "JSON")


def _read_text(
    path: Path, fault: type[UgatMarlError], parse: Callable[[str], Any], kind: str
) -> Any:
    refuse_endless(path, fault)
    try:
        if path.stat().st_size > _LONGEST:
            raise fault(
                f"{path}: has more than {_LONGEST >> 20} MiB, which no such file needs; is it "
                "another file?"
            )
        text = path.read_text(encoding="utf-8-sig")  # some editors begin files with a mark
    except UnicodeDecodeError as error:
        raise fault(f"{path}: not UTF-8 ({error.reason}); save it as UTF-8") from None
    except OSError as error:
        raise fault(f"{path}: cannot be read ({error.strerror})") from None
    return _parsed(text, str(path), fault, parse, kind)


def _parsed(
    text: str, name: str, fault: type[UgatMarlError], parse: Callable[[str], Any], kind: str
) -> Any:
    try:
        content = parse(text)
    except RecursionError:
        raise fault(f"{name}: {_TOO_DEEP}") from None
    except json.JSONDecodeError as error:
        raise fault(
            f"{name}, line {error.lineno}: not valid {kind} ({error.msg}); the file may have been "
            "cut short"
        ) from None
    except tomllib.TOMLDecodeError as error:
        raise fault(
            f"{name}: not valid {kind}: {error}; the file may have been cut short"
        ) from None
    except ValueError:  # more digits than Python reads
        raise fault(f"{name}: {_TOO_LONG}") from None
    require_bounded(content, name, fault)
    return content


def require_bounded(content: Any, name: str, fault: type[UgatMarlError]) -> None:
    """Refuse what was read from JSON or TOML if it is nested too deeply or has a huge integer.

    Args:
        content: The plain values.
        name: Name of their place in errors.
        fault: Kind of the error to raise.

    Raises:
        UgatMarlError: As `fault`.
    """
    level = [content]
    for _ in range(_DEEPEST):
        level = [part for value in level for part in _parts_of(value)]
        if any(isinstance(value, int) and abs(value) > _LARGEST for value in level):
            raise fault(f"{name}: {_TOO_LONG}")
        if not level:
            return
    raise fault(f"{name}: {_TOO_DEEP}")


def _parts_of(value: Any) -> Iterable[Any]:
    if isinstance(value, dict):
        return value.values()
    return value if isinstance(value, list) else ()


class Tag(NamedTuple):
    """Start of an element of a long XML document.

    Attributes:
        name: Tag of the element.
        attributes: Its attributes.
        line: Its line in the document, from 1.
        parent: Tag of the element around it; empty for the root.
        section: Tag of the child of the root around it; empty for the root and its children.
    """

    name: str
    attributes: dict[str, str]
    line: int
    parent: str = ""
    section: str = ""


def chunks_of(path: Path, reporter: Reporter | None = None) -> Iterator[bytes]:
    """Yield the content of `path` piece by piece, unpacked if its name ends in ``.gz``.

    Args:
        path: The file.
        reporter: Shows progress if reading takes long.

    Raises:
        ScenarioError: As for `read_bytes`.
    """
    refuse_endless(path, ScenarioError)
    try:
        with path.open("rb") as raw, gzip.open(raw) if path.suffix == ".gz" else raw as file:
            pieces = iter(lambda: file.read(_PIECE), b"")
            if path.suffix == ".gz":
                if not (packed := path.stat().st_size):
                    raise EOFError("it is empty")
                pieces = _bounded(pieces, path, packed)
            yield from watched(pieces, raw, reporter or Silent())
    except FileNotFoundError:
        raise ScenarioError(f"{path}: no such file") from None
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise ScenarioError(
            f"{path}: not a whole gzip archive ({error}); it may have been cut short"
        ) from None
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None


def scan_xml(pieces: Iterable[bytes], name: str) -> Iterator[Tag]:
    """Yield the start of every element of a document of any length, in little memory.

    Args:
        pieces: The document, cut anywhere.
        name: Name of the document in errors, usually its path.

    Raises:
        ScenarioError: As for `parse_xml`.
    """
    parser = _refusing_parser(name)
    tags: list[Tag] = []
    around = [""]

    def start(tag: str, attributes: dict[str, str]) -> None:
        section = around[2] if len(around) > 2 else ""
        tags.append(Tag(tag, attributes, parser.CurrentLineNumber, around[-1], section))
        around.append(tag)
        if len(around) > _DEEPEST + 1:  # with the text around the root
            _refuse_depth(parser, name)

    def end(tag: str) -> None:
        del tag, around[-1]

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    for piece in pieces:
        _parse(parser, piece, False, name)
        yield from tags
        tags.clear()
    _parse(parser, b"", True, name)
    yield from tags


def parse_xml(content: bytes, name: str) -> ET.Element:
    """Parse XML without document types or entities.

    Args:
        content: The document.
        name: Name of the document in errors, usually its path.

    Raises:
        ScenarioError: The document is not well-formed (perhaps cut short), or declares a document
            type or an entity.
    """
    growing = _GrowingTree(name)
    for begin in range(0, len(content), _PIECE):
        growing.read(content[begin : begin + _PIECE])
    return growing.ended()


def read_xml(path: Path) -> ET.Element:
    """Parse the XML of a file, which may be packed, without document types or entities.

    Raises:
        ScenarioError: The file is missing or unreadable, or its XML is at fault (see `parse_xml`).
    """
    return parse_xml(read_bytes(path), str(path))


def parts_of_xml(pieces: Iterable[bytes], name: str) -> Iterator[ET.Element]:
    """Yield a document of any length as trees: copies of its root, each with the next children.

    Each part holds only whole children. There is at least one part.

    Args:
        pieces: The document, cut anywhere.
        name: Name of the document in errors, usually its path.

    Raises:
        ScenarioError: As for `parse_xml`.
    """
    growing = _GrowingTree(name)
    for piece in pieces:
        growing.read(piece)
        if (part := growing.whole_children()) is not None:
            yield part
    yield growing.ended()


class _GrowingTree:
    """A tree that grows with the pieces of its document, and is not deeper than `_DEEPEST`.

    Expat calls the builder without Python in between: a method of ours for each element would take
    a third of the time.

    Args:
        name: Name of the document in errors.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._root: ET.Element | None = None
        self._shallow = 0  # children that are whole, and were looked through
        self._new = 0  # bytes since the last look
        self._wait = 0  # bytes until the next one, if a child goes on
        self._builder = ET.TreeBuilder()
        self._parser = _refusing_parser(name)
        self._parser.buffer_text = True
        self._parser.StartElementHandler = self._first
        self._parser.EndElementHandler = self._builder.end
        self._parser.CharacterDataHandler = self._builder.data

    def _first(self, tag: str, attributes: dict[str, str]) -> None:
        self._root = self._builder.start(tag, attributes)
        self._parser.StartElementHandler = self._builder.start

    def read(self, piece: bytes) -> None:
        """Read the next piece.

        Raises:
            ScenarioError: As for `parse_xml`.
        """
        _parse(self._parser, piece, False, self._name)
        self._new += len(piece)
        if self._new >= self._wait:
            self._look()

    def _look(self) -> None:
        """Refuse a deep tree. A child that goes on is looked through each time it has doubled."""
        if self._root is None:
            return
        if _are_deep(self._root[self._shallow :]):
            _refuse_depth(self._parser, self._name)
        whole = max(0, len(self._root) - 1)
        self._wait = self._wait + self._new if whole == self._shallow else 0
        self._shallow, self._new = whole, 0

    def whole_children(self) -> ET.Element | None:
        """Remove the complete children and return them under a copy of the root.

        The last child may be incomplete, and stays. Return None if there are no others.
        """
        if self._root is None or len(self._root) < 2:
            return None
        part = ET.Element(self._root.tag, self._root.attrib)
        part[:] = self._root[:-1]
        del self._root[:-1]
        self._shallow = 0
        return part

    def ended(self) -> ET.Element:
        """Return the tree, or what is left of it, behind the last piece.

        Raises:
            ScenarioError: As for `parse_xml`.
        """
        _parse(self._parser, b"", True, self._name)
        self._look()
        return self._builder.close()


def _are_deep(children: list[ET.Element]) -> bool:
    """Return True if more than `_DEEPEST` elements lie inside each other, with the root."""
    level = children
    for _ in range(1, _DEEPEST):
        if not level:
            return False
        level = [inner for element in level for inner in element]
    return bool(level)


def _refuse_depth(parser: expat.XMLParserType, name: str) -> None:
    raise ScenarioError(
        f"{name}, line {parser.CurrentLineNumber}: more than {_DEEPEST} elements inside each "
        "other, which no file of a scenario needs"
    )


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


_HANDLERS = (
    "StartElementHandler",
    "EndElementHandler",
    "CharacterDataHandler",
    "StartDoctypeDeclHandler",
    "EntityDeclHandler",
)


def _parse(parser: expat.XMLParserType, content: bytes, last: bool, name: str) -> None:
    try:
        parser.Parse(content, last)
    except expat.ExpatError as error:
        raise ScenarioError(
            f"{name}: not well-formed XML ({error}); the file may have been cut short"
        ) from None
    except (ValueError, LookupError) as error:
        raise ScenarioError(f"{name}: cannot be decoded: {error}") from None
    finally:
        if last:  # handlers know the parser; in this cycle the whole tree would wait for the gc
            for handler in _HANDLERS:
                setattr(parser, handler, None)


def xml_bytes(root: ET.Element) -> bytes:
    """Serialise an element tree as an indented UTF-8 document."""
    ET.indent(root, "    ")
    return ET.tostring(root, encoding="UTF-8", xml_declaration=True) + b"\n"


def child_texts(root: ET.Element) -> list[str]:
    """Return each child of an element as text, indented as in `xml_bytes`.

    Elements have names without namespaces, as those of `parse_xml`. This is twice as fast as
    ElementTree, in which a third of the time to apply effects would go.
    """
    return [_element_text(child, f"\n{_INDENT}") for child in root]


def _element_text(element: ET.Element, margin: str) -> str:
    """Return an element as text; its lines begin with `margin`, a line break and spaces."""
    given = element.attrib
    if _SPECIAL.search("".join(given.values())):
        given = {name: value.translate(_IN_ATTRIBUTE) for name, value in given.items()}
    attributes = "".join([f' {name}="{value}"' for name, value in given.items()])
    tag, text = element.tag, element.text or ""
    if not len(element):
        inside = f">{text.translate(_IN_TEXT)}</{tag}>" if text else " />"
        return f"<{tag}{attributes}{inside}"
    inner = margin + _INDENT
    parts = [f"<{tag}{attributes}>", text.translate(_IN_TEXT) if text.strip() else inner]
    for number, child in enumerate(element, 1):
        after = inner if number < len(element) else margin
        tail = child.tail or ""
        parts += [_element_text(child, inner), tail.translate(_IN_TEXT) if tail.strip() else after]
    return f"{''.join(parts)}</{tag}>"


_SENT_WHOLE: ContextVar[bool] = ContextVar("sent_whole", default=False)


@contextmanager
def files_sent_whole() -> Iterator[None]:
    """Pickle documents with their content within a ``with`` block, for machines without the files.

    Elsewhere an unchanged file is pickled as its path, since other processes here can read it.
    """
    before = _SENT_WHOLE.set(True)
    try:
        yield
    finally:
        _SENT_WHOLE.reset(before)


@dataclass(frozen=True)
class Document:
    """One SUMO input file: unchanged on disk, or edited.

    Attributes:
        name: File name, without directories.
        path: Path of the file on disk, or None if the document exists only in memory.
        content: The edited bytes, or None if the file on disk is used.
        home: Folder of an edited document that is too long for memory. The folder is removed with
            this object.
        in_rows: True if the content is known to be as `DocumentDraft` writes it.
    """

    name: str
    path: Path | None = None
    content: bytes | None = None
    home: OwnDirectory | None = field(default=None, compare=False, repr=False)
    in_rows: bool = field(default=False, compare=False, repr=False)

    def __reduce__(self) -> tuple[Any, ...]:
        if self.home is None and not _SENT_WHOLE.get():
            return Document, (self.name, self.path, self.content, None, self.in_rows)
        copy = self.edited(self.read())  # it may outlive the file, or be elsewhere
        return Document, (copy.name, None, copy.content, None, self.in_rows)

    @property
    def source(self) -> str:
        """Name of the document in errors."""
        return self.name if self.path is None or self.home is not None else str(self.path)

    def read(self) -> bytes:
        """Return the unpacked bytes."""
        if self.content is not None:
            return self.content
        assert self.path is not None
        return read_bytes(self.path)

    def pieces(self, reporter: Reporter | None = None) -> Iterator[bytes]:
        """Yield the unpacked bytes piece by piece, in little memory.

        Args:
            reporter: Shows progress if the document is a long file.
        """
        if self.content is not None:
            yield self.content
            return
        assert self.path is not None
        yield from chunks_of(self.path, reporter)

    def scan(self, reporter: Reporter | None = None) -> Iterator[Tag]:
        """Yield the starts of the elements with their lines, in little memory.

        Args:
            reporter: Shows progress if the document is a long file; by default the program's usual
                reporter.
        """
        return scan_xml(self.pieces(reporter or usual()), self.source)

    def parse(self) -> ET.Element:
        """Return the document as an element tree, a fresh one at each call."""
        return parse_xml(self.read(), self.source)

    def parts(self) -> Iterator[ET.Element]:
        """Yield the document as trees (see `parts_of_xml`); show progress if it is a long file."""
        return parts_of_xml(self.pieces(usual()), self.source)

    def rows(self) -> Rows | None:
        """Return the children as texts, to read or change few of them.

        The document is cached as it was rewritten for this, because many scenarios derive from one.

        Returns:
            None if the document is too long, or if a text in it looks like the start of a child.
        """
        document = self if self.in_rows else self._rewritten()
        if document is None or not document.in_rows:
            return None
        assert document.content is not None
        start, *children = _BEGINS_ROW.split(document.content.decode())
        if not children:
            return Rows(document.name, start, (), "")
        children[-1], tag, end = children[-1].rpartition("\n</")
        return Rows(document.name, start, tuple(children), f"{tag}{end}")

    def _rewritten(self) -> Document | None:
        """Return the document as a `DocumentDraft`, which is kept; None if the file is long."""
        state = None  # an edited document does not change; a file may, between two episodes
        if self.content is None and self.path is not None:
            stat = self.path.stat()
            if stat.st_size > _KEPT:
                return None
            state = stat.st_mtime_ns, stat.st_size
        kept: tuple[Any, Document] | None = self.__dict__.get("_kept")
        if kept is None or kept[0] != state:
            kept = self.__dict__["_kept"] = state, self.changed(lambda _: None)
        return kept[1]

    def changed(self, change: Callable[[ET.Element], object]) -> Document:
        """Return a document whose parts (see `parts`) a function has changed, in little memory."""
        draft = None
        for part in self.parts():
            change(part)
            draft = draft or DocumentDraft(self.name.removesuffix(".gz"), part)
            draft.add(*child_texts(part))
        assert draft is not None
        return draft.document()

    def edited(self, content: bytes) -> Document:
        """Return a document with the same name and other content."""
        return Document(self.name.removesuffix(".gz"), None, content)

    def write(self, path: Path) -> None:
        """Write the document to `path`; an unchanged file is copied, still packed if it was."""
        with replacing(path) as temporary:
            if self.content is not None:
                temporary.write_bytes(self.content)
            else:
                assert self.path is not None
                shutil.copyfile(self.path, temporary)


@dataclass(frozen=True)
class Rows:
    """A document as the texts of its children, each with its place.

    Attributes:
        name: File name.
        start: Text before the first child.
        children: Texts of the children, as from `child_texts`.
        end: Text behind the last child.
    """

    name: str
    start: str
    children: tuple[str, ...]
    end: str

    def with_any(self, texts: Iterable[str]) -> list[int]:
        """Return the numbers of the children in which a text occurs."""
        wanted = tuple(texts)
        return [
            number
            for number, child in enumerate(self.children)
            if any(text in child for text in wanted)
        ]

    def parse(self, numbers: Iterable[int]) -> ET.Element:
        """Return a tree with some of the children."""
        return parse_xml(self._with(self.children[number] for number in numbers), self.name)

    def replaced(self, children: Mapping[int, str]) -> Document:
        """Return the document with other texts of some children, by their numbers."""
        texts = (children.get(number, text) for number, text in enumerate(self.children))
        return Document(self.name, None, self._with(texts), None, in_rows=True)

    def _with(self, children: Iterable[str]) -> bytes:
        rows = (f"\n{_INDENT}{child}" for child in children)
        return "".join((self.start, *rows, self.end)).encode()


class DocumentDraft:
    """An XML document under construction: in memory, or in a file once it is long.

    Args:
        name: File name.
        root: Root of the document; its children are ignored.
    """

    def __init__(self, name: str, root: ET.Element) -> None:
        self._name, self._tag = name, root.tag
        self._start = ET.tostring(ET.Element(root.tag, root.attrib), "unicode")
        self._children = 0
        self._home: OwnDirectory | None = None
        self._path: Path | None = None
        self._file: BinaryIO = io.BytesIO()
        self._file.write(b"<?xml version='1.0' encoding='UTF-8'?>\n")

    def add(self, *children: str) -> None:
        """Write children, given as texts from `child_texts`."""
        if not children:
            return
        start = "" if self._children else f"{self._start.removesuffix(' />')}>"
        self._children += len(children)
        with scratch():
            self._file.write("".join((start, *(f"\n{_INDENT}{x}" for x in children))).encode())
            if isinstance(self._file, io.BytesIO) and self._file.tell() > _KEPT:
                begun, self._home = self._file.getvalue(), OwnDirectory()
                self._path = self._home.fresh() / self._name
                self._path.parent.mkdir(mode=0o700)
                self._file = self._path.open("wb")
                self._file.write(begun)

    def document(self) -> Document:
        """Return the text written so far as a document."""
        end = f"\n</{self._tag}>" if self._children else self._start
        with scratch():
            self._file.write(f"{end}\n".encode())
            content = self._file.getvalue() if isinstance(self._file, io.BytesIO) else None
            self._file.close()
        # A text between elements may look as if a child began there.
        in_rows = content is not None and _rows_in(content) == self._children
        return Document(self._name, self._path, content, self._home, in_rows)


def _rows_in(content: bytes) -> int:
    return sum(1 for _ in _BEGINS_ROW.finditer(content.decode()))


class OwnDirectory:
    """Source of fresh folders, one at a time; each new folder replaces the one before.

    The last folder is removed with this object, but not by a forked child with a copy of it.
    """

    def __init__(self) -> None:
        self._remove: weakref.finalize[..., OwnDirectory] | None = None

    def fresh(self) -> Path:
        """Return the path of a new folder, which the caller has to make."""
        self.remove()
        directory = Path(tempfile.gettempdir()) / f"ugat_marl-{secrets.token_hex(8)}"
        self._remove = weakref.finalize(self, _remove_tree, directory, os.getpid())
        return directory

    def remove(self) -> None:
        """Remove the folder, if there is one."""
        remove, self._remove = self._remove, None
        if remove is not None:
            remove()


def _remove_tree(directory: Path, owner: int) -> None:
    if os.getpid() == owner:
        shutil.rmtree(directory, ignore_errors=True)
