"""Files are whole or absent, and XML can do nothing but be read."""

from __future__ import annotations

import contextlib
import gc
import gzip
import math
import os
import random
import signal
import stat
import subprocess
import time
import weakref
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ugat_marl import files
from ugat_marl.errors import LogError, MeasuredDataError, OutputError, ScenarioError
from ugat_marl.files import (
    child_texts,
    chunks_of,
    distinct_endings,
    json_values,
    parse_xml,
    read_bytes,
    replacing,
    require_writable,
    write_whole,
    xml_bytes,
)


def test_write_whole_writes_and_leaves_nothing_else(tmp_path: Path) -> None:
    file = tmp_path / "deep" / "er" / "file.txt"
    write_whole(file, "grün")
    assert file.read_bytes() == "grün".encode()
    write_whole(file, b"\x00\x01")
    assert file.read_bytes() == b"\x00\x01"
    assert list(file.parent.iterdir()) == [file]


@pytest.mark.parametrize(
    ("paths", "endings"),
    [
        ((), []),
        (("runs/a/policy",), ["policy"]),
        (("runs/a/policy", "runs/b/policy", "other"), ["a/policy", "b/policy", "other"]),
        (("a/policy", "./a/policy"), None),
    ],
)
def test_endings_of_paths_are_as_long_as_they_must_be_to_differ(
    paths: tuple[str, ...], endings: list[str] | None
) -> None:
    assert distinct_endings(map(Path, paths)) == endings


def test_numbers_that_json_has_not_are_null() -> None:
    held = {"a": (1.5, math.nan), 2: [{"b": -math.inf}, "nan"]}
    assert json_values(held) == {"a": [1.5, None], 2: [{"b": None}, "nan"]}


def test_a_name_of_another_kind_is_refused_before_and_after_there_is_a_file(tmp_path: Path) -> None:
    path = tmp_path / "episodes.csv"
    for told in (r"a \.parquet file is written here; give", r"there is a file of this name"):
        with pytest.raises(OutputError, match=told):
            require_writable(path, ".parquet")
        path.write_text("kept")
    require_writable(tmp_path / "episodes.parquet", ".parquet")


def test_a_failed_block_leaves_the_old_file(tmp_path: Path) -> None:
    file = tmp_path / "file.txt"
    file.write_text("old")

    def fail() -> None:
        with replacing(file) as temporary:
            temporary.write_text("half of the n")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_the_file_gets_the_rights_any_new_file_gets(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        write_whole(tmp_path / "file", b"")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o640


def test_a_file_that_is_replaced_keeps_its_rights(tmp_path: Path) -> None:
    file = tmp_path / "secret"
    file.touch()
    file.chmod(0o600)
    with replacing(file) as temporary:
        assert stat.S_IMODE(temporary.stat().st_mode) == 0o600
    file.chmod(0o444)
    write_whole(file, b"new")
    assert stat.S_IMODE(file.stat().st_mode) == 0o444
    assert file.read_bytes() == b"new"


KILLED = """
import os, sys, time
from pathlib import Path
from ugat_marl.files import replacing
with replacing(Path(sys.argv[1])) as temporary:
    with temporary.open("wb") as file:
        file.write(b"new" * 1000)
        file.flush()
        print("half", flush=True)
        time.sleep(60)
"""


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_process_killed_while_writing_leaves_the_old_file(
    how: signal.Signals, tmp_path: Path, python: list[str]
) -> None:
    file = tmp_path / "table.parquet"
    file.write_bytes(b"old")
    with subprocess.Popen(
        [*python, "-c", KILLED, str(file)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"half\n"
        process.send_signal(how)
        process.wait(20)
    assert file.read_bytes() == b"old"
    # A name that no pattern of ours picks up; and nothing at all where Python could clean up.
    left = [path.name for path in tmp_path.iterdir() if path != file]
    assert all(name.startswith(".") and name.endswith(".tmp") for name in left)
    if how == signal.SIGINT:
        assert not left


def test_a_writer_killed_at_any_moment_leaves_a_whole_file(
    tmp_path: Path, python: list[str]
) -> None:
    """A process rewrites a file as fast as it can and is killed: never half of anything."""
    script = (
        "import sys, itertools\nfrom pathlib import Path\nfrom ugat_marl.files import write_whole\n"
        "print('go', flush=True)\n"
        "for n in itertools.count():\n    write_whole(Path(sys.argv[1]), str(n % 10) * 300_000)\n"
    )
    file = tmp_path / "file"
    for pause in (0.03, 0.05, 0.09):
        with subprocess.Popen(
            [*python, "-c", script, str(file)], stdout=subprocess.PIPE
        ) as process:
            assert process.stdout is not None
            process.stdout.readline()
            deadline = time.monotonic() + 10
            while not file.exists() and time.monotonic() < deadline:
                time.sleep(0.01)
            time.sleep(pause)
            process.kill()
            process.wait(20)
        content = file.read_text()
        assert len(content) == 300_000
        assert set(content) == {content[0]}


def test_read_bytes_unpacks(tmp_path: Path) -> None:
    (tmp_path / "a.xml").write_bytes(b"<a/>")
    (tmp_path / "a.xml.gz").write_bytes(gzip.compress(b"<a/>"))
    assert read_bytes(tmp_path / "a.xml") == read_bytes(tmp_path / "a.xml.gz") == b"<a/>"


PACKED = gzip.compress(bytes(range(256)) * 200)


@pytest.mark.parametrize(
    "content",
    [
        PACKED[:-20],
        PACKED[:5],
        b"<net/>",
        PACKED[:30] + b"\xff\xff\xff" + PACKED[33:],
        b"",
    ],
    ids=["cut", "header only", "not packed", "damaged inside", "empty"],
)
@pytest.mark.parametrize("read", [read_bytes, lambda file: [*chunks_of(file)]])
def test_a_broken_archive_is_named(
    read: Callable[[Path], object], content: bytes, tmp_path: Path
) -> None:
    file = tmp_path / "net.xml.gz"
    file.write_bytes(content)
    with pytest.raises(ScenarioError, match=r"net\.xml\.gz: not a whole gzip archive"):
        read(file)


def test_a_missing_file_and_a_directory_are_named(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"gone\.xml: no such file"):
        read_bytes(tmp_path / "gone.xml")
    with pytest.raises(ScenarioError, match="cannot be read: .*directory"):
        read_bytes(tmp_path)


DOCUMENT = b"""<?xml version="1.0" encoding="UTF-8"?>
<!-- who made it -->
<net version="1.20" xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance"
     xsi:noNamespaceSchemaLocation="http://sumo.dlr.de/xsd/net_file.xsd">
    <edge id="a&amp;b"/> text &lt; <edge id="\xc3\xbc"/> tail
</net>
"""


def test_xml_survives_reading_and_writing() -> None:
    root = parse_xml(DOCUMENT, "net")
    again = parse_xml(xml_bytes(root), "net")
    for tree in (root, again):
        assert tree.tag == "net"
        assert tree.get("xsi:noNamespaceSchemaLocation", "").endswith("net_file.xsd")
        assert [edge.get("id") for edge in tree.iter("edge")] == ["a&b", "ü"]


def test_a_tree_is_freed_with_its_last_name() -> None:
    """In a cycle it would wait for the garbage collection, which frozen processes do without."""
    gc.disable()
    try:
        freed = weakref.ref(parse_xml(DOCUMENT, "net"))
        assert freed() is None
    finally:
        gc.enable()


@given(st.dictionaries(st.sampled_from("abc"), st.text(max_size=20).filter(str.isprintable)))
def test_any_attribute_survives(attributes: dict[str, str]) -> None:
    root = parse_xml(b"<r/>", "r")
    for key, value in attributes.items():
        root.set(key, value)
    assert dict(parse_xml(xml_bytes(root), "r").items()) == attributes


@st.composite
def damaged_documents(draw: st.DrawFn) -> bytes:
    """`DOCUMENT` with bytes changed, cut out or doubled."""
    content = DOCUMENT
    for _ in range(draw(st.integers(1, 3))):
        begin = draw(st.integers(0, max(0, len(content) - 1)))
        end = begin + draw(st.integers(1, 20))
        other = draw(st.one_of(st.binary(max_size=1), st.just(content[begin:end] * 2)))
        content = content[:begin] + other + content[end:]
    return content


@given(st.one_of(st.binary(max_size=200), damaged_documents()))
def test_no_bytes_are_a_traceback(content: bytes) -> None:
    with contextlib.suppress(ScenarioError):
        parse_xml(content, "here")


@given(st.integers(0, len(DOCUMENT) - 9))
def test_a_document_cut_anywhere_is_refused(length: int) -> None:
    with pytest.raises(ScenarioError, match="net: not well-formed XML .*cut short"):
        parse_xml(DOCUMENT[:length], "net")


def laughs() -> str:
    """The billion laughs: ten entities, each ten times the one before."""
    entities = '<!ENTITY lol0 "lol">' + "".join(
        f'<!ENTITY lol{n} "{f"&lol{n - 1};" * 10}">' for n in range(1, 10)
    )
    return f'<?xml version="1.0"?><!DOCTYPE lolz [{entities}]><lolz>&lol9;</lolz>'


@pytest.mark.parametrize(
    "content",
    [
        laughs(),
        '<!DOCTYPE r SYSTEM "file:///etc/passwd"><r/>',
        '<!DOCTYPE r [<!ENTITY e SYSTEM "file:///etc/passwd">]><r>&e;</r>',
        '<!DOCTYPE r [<!ENTITY % p SYSTEM "http://localhost/x"> %p;]><r/>',
        "<!DOCTYPE r><r/>",
    ],
)
def test_document_types_and_entities_are_refused(content: str) -> None:
    with pytest.raises(ScenarioError, match="here: document types and entities are not accepted"):
        parse_xml(content.encode(), "here")


def test_an_unknown_encoding_is_named() -> None:
    with pytest.raises(ScenarioError, match="here: "):
        parse_xml(b'<?xml version="1.0" encoding="klingon"?><r/>', "here")
    with pytest.raises(ScenarioError, match="here: "):
        parse_xml("<r>ü</r>".encode("latin-1"), "here")


def test_an_archive_made_to_fill_memory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "_UNPACKED", 1 << 20)
    bomb = tmp_path / "net.xml.gz"
    bomb.write_bytes(gzip.compress(b"<a>" + b" " * (4 << 20) + b"</a>"))
    with pytest.raises(ScenarioError, match="unpack to more than 100 times as many"):
        files.read_bytes(bomb)
    with pytest.raises(ScenarioError, match="unpack to more than 100 times as many"):
        list(files.chunks_of(bomb))
    honest = b"".join(b"<b id='%d'/>" % random.Random(i).getrandbits(64) for i in range(90000))
    bomb.write_bytes(gzip.compress(honest))
    assert files.read_bytes(bomb) == honest == b"".join(files.chunks_of(bomb))


TEXTS = {
    "deep.json": ("[" * 100_000, "more than 64 tables or lists inside each other"),
    "deeper.json": ("[" * 65 + "]" * 65, "more than 64 tables or lists inside each other"),
    "deep.toml": ("a = " + "[" * 100_000, "more than 64 tables or lists inside each other"),
    "deeper.toml": ("a = " + "[" * 65 + "]" * 65, "more than 64 tables or lists"),
    "long.json": ("1" * 5000, "a number is far too long"),
    "long.toml": ("a = " + "1" * 5000, "a number is far too long"),
    "cut.json": ('{"a": [1,', r"not valid JSON \(.*cut short"),
    "cut.toml": ("a = [1,", "not valid TOML: .*cut short"),
    "latin.json": (b'"\xe9"', "not UTF-8"),
    "latin.toml": (b"a = '\xe9'", "not UTF-8"),
    "large.json": (b" " * (2 << 20), "has more than 1 MiB"),
    "large.toml": (b" " * (2 << 20), "has more than 1 MiB"),
}


@pytest.mark.parametrize("name", TEXTS)
def test_json_and_toml_made_to_harm_are_refused_in_one_line(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "_LONGEST", 1 << 20)
    content, says = TEXTS[name]
    path = tmp_path / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    read = files.read_json if path.suffix == ".json" else files.read_toml
    with pytest.raises(MeasuredDataError, match=rf"^{path}.*: {says}") as refused:
        read(path, MeasuredDataError)
    assert "\n" not in str(refused.value)


def test_json_and_toml_as_deep_as_allowed_are_read(tmp_path: Path) -> None:
    deep = "[" * 64 + "]" * 64
    (tmp_path / "a.json").write_text(deep)
    (tmp_path / "a.toml").write_text(f"a = {deep[1:-1]}")
    assert str(files.read_json(tmp_path / "a.json", LogError)) == deep
    assert str(files.read_toml(tmp_path / "a.toml", LogError)["a"]) == deep[1:-1]
    with pytest.raises(LogError, match=r"none\.json: cannot be read \(No such file"):
        files.read_json(tmp_path / "none.json", LogError)
    with pytest.raises(LogError, match="^provenance: more than 64 tables"):
        files.parse_json("[" * 65 + "]" * 65, "provenance", LogError)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names on Windows")
def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "x.sumocfg"
    os.mkfifo(path)
    for read in (
        lambda: files.read_bytes(path),
        lambda: list(files.chunks_of(path)),
        lambda: files.read_json(path, ScenarioError),
    ):
        with pytest.raises(ScenarioError, match=r"x\.sumocfg: is a pipe or a device"):
            read()


def test_a_cache_without_a_home(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", no_home)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    with pytest.raises(OutputError, match="no home folder.*XDG_CACHE_HOME"):
        files.user_cache("x")
    monkeypatch.setenv("XDG_CACHE_HOME", "/cache")
    assert files.user_cache("x") == Path("/cache/ugat_marl/x")


XML_NAMES, XML_VALUES = (
    st.sampled_from(["a", "b:c", "vType"]),
    st.text("a1 <>&\"'\n\r\té", max_size=5),
)
XML_TEXTS = st.none() | st.sampled_from(["", " ", "\n  ", 'te<x&t>"é', " x "])


@st.composite
def elements(draw: st.DrawFn, depth: int = 3) -> ET.Element:
    """Any element, as a parser of XML without namespaces may return it."""
    made = ET.Element(draw(XML_NAMES), draw(st.dictionaries(XML_NAMES, XML_VALUES, max_size=3)))
    made.text = draw(XML_TEXTS)
    for child in draw(st.lists(elements(depth - 1), max_size=3)) if depth else ():
        child.tail = draw(XML_TEXTS)
        made.append(child)
    return made


@settings(deadline=None)
@given(elements())
def test_texts_of_children_are_those_of_elementtree(root: ET.Element) -> None:
    end = "\0"
    texts = child_texts(root)
    root.text = None
    for child in root:
        child.tail = end
    ET.indent(root, "    ")
    whole = ET.tostring(root, "unicode")
    assert texts == (whole[whole.index(">") + 1 :].lstrip().split(end)[:-1] if len(root) else [])


def test_a_link_goes_on_to_point_at_what_is_written(tmp_path: Path) -> None:
    target, link = tmp_path / "deep" / "target.txt", tmp_path / "link.txt"
    write_whole(target, "old")
    link.symlink_to(target)
    write_whole(link, "new")
    assert link.is_symlink() and target.read_text() == "new"


def test_a_pipe_is_not_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(OutputError, match="is no file, but a device or a pipe"):
        write_whole(pipe, "text")
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_a_long_name_can_be_written(tmp_path: Path) -> None:
    write_whole(tmp_path / ("a" * 250), "text")
    with pytest.raises(OutputError, match="cannot be written"):
        write_whole(tmp_path / ("a" * 300), "text")


def test_a_name_in_another_encoding_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"'made of caf.*' in it is not UTF-8; rename that file"):
        files.write_whole(tmp_path / "README.md", "made of caf\udce9.net.xml")
    assert not list(tmp_path.iterdir())
