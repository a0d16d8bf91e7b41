"""Every command in the pages, in the help and in messages is one that the command line takes."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ugat_marl.__main__ import COMMANDS, LINE, main
from ugat_marl.cli import frame
from ugat_marl.errors import install_command
from ugat_marl.experiments.jobs import file_name
from ugat_marl.experiments.row_names import CONTROL, CORRECTED, DIRECT, PHASE, STREET, TIMED

ROOT = Path(__file__).resolve().parents[2]
PAGES = [
    *(ROOT / name for name in ("README.md", "scenarios/README.md", "baselines/README.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
]
WRITTEN = {file_name(name) for name in (CONTROL, CORRECTED, DIRECT, PHASE, STREET, TIMED)}
"""Names of the policies that a run writes, without suffix."""

ALGORITHM = """
class MyLearner:
    def learn(self, env, episodes): ...
    def policy(self): ...

def my_policy(observations): ...
"""


def whole_lines(text: str) -> list[str]:
    """Lines of a shell block; lines that end in a backslash are joined with the next."""
    return text.replace("\\\n", " ").splitlines()


def in_pages() -> list[Any]:
    """Every command in a shell block of a page."""
    found: list[Any] = []
    for page in PAGES:
        blocks = re.findall(r"^```(?:sh|bash)\n(.*?)^```", page.read_text(), flags=re.M | re.S)
        lines = [line.strip() for block in blocks for line in whole_lines(block)]
        found += [
            pytest.param(line, id=f"{page.relative_to(ROOT)}: {line[:60]}")
            for line in lines
            if line.startswith("ugat-marl ") and "$" not in line  # a loop of the shell
        ]
    return found


def in_help() -> list[Any]:
    """Every example in the help of a command, and the first tries."""
    found = [pytest.param(line, id=f"help: {line[:60]}") for line in LINE.examples]
    for place, _ in COMMANDS.values():
        module, _, attribute = place.partition(":")
        text = inspect.getdoc(getattr(importlib.import_module(module), attribute)) or ""
        examples = text.partition("Examples:\n")[2].partition("Attributes:")[0]
        joined = re.sub(r"\n +(?!ugat-marl)(?=\S)", " ", examples)
        found += [
            pytest.param(line.strip(), id=f"help: {line.strip()[:60]}")
            for line in joined.splitlines()
            if line.strip().startswith("ugat-marl ")
        ]
    return found


def in_makefile() -> list[Any]:
    """Every command that `make` or the trial of the wheel runs."""
    made = [
        line.replace("$(BIN)/", "").replace("$(ARGS)", "").removeprefix("OMP_NUM_THREADS=1 ")
        for line in map(str.strip, whole_lines((ROOT / "Makefile").read_text()))
        if "/ugat-marl " in line
    ]
    tree = ast.parse((ROOT / ".ci" / "package.py").read_text())
    tried = [
        f"ugat-marl {node.value}"
        for place in tree.body
        if isinstance(place, ast.Assign) and ast.unparse(place.targets[0]) in ("TRAIN", "COMMANDS")
        for node in ast.walk(place.value)
        if isinstance(node, ast.Constant)
    ]
    return [pytest.param(line, id=f"make: {line[:60]}") for line in (*made, *tried)]


def sentences(source: str) -> Iterator[str]:
    """Yield the texts of a module but docstrings; ``{}`` stands for what is filled in."""
    tree = ast.parse(source)
    loose = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    parts = {
        id(part)
        for node in ast.walk(tree)
        if isinstance(node, ast.JoinedStr)
        for part in ast.walk(node)
        if part is not node
    }
    for node in ast.walk(tree):
        if id(node) in loose or id(node) in parts:
            continue
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value
        elif isinstance(node, ast.JoinedStr):
            yield "".join(
                part.value if isinstance(part, ast.Constant) else "{}"  # pyright: ignore
                for part in node.values
            )


def in_messages() -> list[Any]:
    """Every command that a message tells to give, with words for what is filled in."""
    found: dict[str, Any] = {}
    for path in sorted((ROOT / "ugat_marl").rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        if "ugat-marl " not in source:
            continue  # each test process collects, and parsing all modules takes seconds
        for text in sentences(source):
            for told in re.findall(r"ugat-marl ([a-z][^`\n,;)(]*)", text):
                line = f"ugat-marl {told}".partition(" (")[0].strip()
                if path.name == "__main__.py" or len(line.split()) < 3 or " lists " in line:
                    continue  # an example of the help, or the name of a verb
                for end in (" as programmes", " for the", " and "):
                    line = line.partition(end)[0]
                name = f"{path.stem}: {line[:60]}"
                line = re.sub(r"(--draw) \{\}|(--out DIR) \{\}$", r"\1\2", line)
                filled = line.replace("--draw", "--draw 7").replace("{}", "single-v1")
                found[line] = pytest.param(filled, id=name)
    return [*found.values()]


def words_of(command: str) -> list[str]:
    """The words after the program's name, without comments and redirections."""
    words = shlex.split(command, comments=True)[1:]
    for stop in (">", "|", "&&", "&"):
        if stop in words:
            words = words[: words.index(stop)]
    return words


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with the user's module that the pages speak of."""
    (tmp_path / "my_algo.py").write_text(ALGORITHM)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


COMMAND_LINES = [*in_pages(), *in_help()]
SAID = [*in_makefile(), *in_messages()]


def test_commands_are_found() -> None:
    assert len(in_pages()) > 60 and len(in_help()) > 40
    assert len(in_makefile()) > 6 and len(in_messages()) > 5


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("command", [*COMMAND_LINES, *SAID])
def test_a_documented_command_is_understood(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    taken: list[Any] = []

    def kept(_line: Any, name: str, words: list[str]) -> Any:
        parsed = parse(LINE, name, words)
        taken.append(parsed)
        return type("Nothing", (), {"run": lambda *_: 0})()

    parse = frame._parse
    monkeypatch.setattr(frame, "_parse", kept)
    try:
        code = main(words_of(command))
    except SystemExit as end:  # help
        code = end.code
    assert code == 0, capsys.readouterr().err


def test_documented_policies_are_those_that_a_run_writes() -> None:
    commands = " ".join(str(case.values[0]) for case in COMMAND_LINES)
    named = re.findall(r"runs/[\w.-]+/policies/([\w.-]+)\.pt", commands)
    assert len(named) > 10
    assert set(named) <= WRITTEN


CHEAP = ("scenario list", "domains", "evaluate")


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    "command",
    [
        case
        for case in COMMAND_LINES
        if str(case.values[0]).removeprefix("ugat-marl ").startswith(CHEAP)
        and not re.search(
            r"\.pt|my[-_]|street1136|evaluate to(day|morrow)|resco:|--domains all|>",
            str(case.values[0]),
        )
    ],
)
def test_a_cheap_command_runs(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = words_of(command)
    if words[0] == "evaluate":
        words += ["--seeds", "1", "--duration-s", "100"]
    assert main(words) == 0, capsys.readouterr().err
    assert capsys.readouterr().out.strip()


def test_messages_name_commands_that_exist() -> None:
    verbs = {name.split()[0] for name in COMMANDS} | {*LINE.short, "completion", "COMMAND"}
    named: set[str] = set()
    for path in (ROOT / "ugat_marl").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        named |= set(re.findall(r"`+ugat-marl ([a-z][\w-]*)", text))
        assert "ugat-marl[" not in text, f"{path}: no index has the package"
    assert named and named <= verbs


def test_an_extra_is_installed_by_its_libraries() -> None:
    assert install_command("ray") == "pip install 'ray>=2.40'"
    assert install_command("sb3").count("'") == 4
    assert install_command("no such extra") == "pip install '.[no such extra]'"
