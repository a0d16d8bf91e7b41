"""Commands in committed tables: each is read from its page and parsed by today's command line."""

from __future__ import annotations

import importlib.util
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest
import tyro

from ugat_marl.__main__ import main
from ugat_marl.cli import frame
from ugat_marl.experiments import PaperConfig

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "results"
PROGRAMS = ("ugat-marl ", "python baselines/")


def commands() -> list[Any]:
    """Every command that stands in a page as a block of its own, and where."""
    found: list[Any] = []
    for page in sorted(RESULTS.rglob("*.md")):
        for line in page.read_text(encoding="utf-8").splitlines():
            text = line.removeprefix("    ")
            if text != line and text.startswith(PROGRAMS):
                found.append(pytest.param(text, id=str(page.relative_to(RESULTS))))
    return found


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Commands that were parsed; none of them runs."""
    given: list[Any] = []

    def keep(line: frame.CommandLine, name: str, rest: list[str]) -> Any:
        given.append(parse(line, name, rest))
        raise KeyboardInterrupt

    parse = frame._parse
    monkeypatch.setattr(frame, "_parse", keep)
    return given


def test_every_table_begins_with_its_command() -> None:
    tables = [*RESULTS.glob("*/*/table.md"), *RESULTS.glob("baselines/*.md")]
    assert len(tables) > 25
    for table in tables:
        heading, _, command = table.read_text(encoding="utf-8").splitlines()[:3]
        assert heading.startswith("# ") and command.startswith("    "), table
        assert command.strip().startswith(PROGRAMS), table


@pytest.mark.parametrize("command", commands())
def test_a_committed_command_is_understood(command: str, parsed: list[Any]) -> None:
    program, *words = shlex.split(command)
    if program == "ugat-marl":
        assert main(words) == 130  # stopped as soon as it was understood
        (made,) = parsed
        if isinstance(getattr(made, "config", None), PaperConfig):  # renamed rows are refused
            rows = [setting.name for setting in made.config.settings(made.table)]
            assert rows[0] == "direct transfer" and set(made.config.rows) <= set(rows)
            assert made.config.targets(made.table)
    else:
        script, *options = words
        assert tyro.cli(command_of(ROOT / script), args=options).run


def command_of(script: Path) -> Any:
    """The dataclass that a script of baselines/ reads its command line into."""
    name = f"commands_{script.stem}"
    spec = importlib.util.spec_from_file_location(name, script)
    assert spec is not None and spec.loader is not None
    module: Any = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module.Results
