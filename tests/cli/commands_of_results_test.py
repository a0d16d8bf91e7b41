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
from ugat_marl.experiments.row_names import PHASE
from ugat_marl.reporting.formats import commands_in

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "results"
PROGRAMS = ("ugat-marl ", "python baselines/")


def blocks(page: Path) -> list[str]:
    """The commands that stand in a page as blocks of their own."""
    commands = commands_in(page.read_text(encoding="utf-8"))
    return [command for command in commands if command.startswith(PROGRAMS)]


TABLES = [*sorted(RESULTS.glob("*/*/table.md")), *sorted(RESULTS.glob("baselines/*.md"))]


def commands() -> list[Any]:
    """Every command that a table was made with, and where it stands."""
    return [
        pytest.param(command, id=str(page.relative_to(RESULTS)))
        for page in TABLES
        for command in blocks(page)
    ]


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


def test_every_table_says_its_command_before_its_figures() -> None:
    assert len(TABLES) > 25
    for table in TABLES:
        before, command, _ = table.read_text(encoding="utf-8").partition("```sh\n")
        assert command and "\n## " not in before and len(blocks(table)) == 1, table


@pytest.mark.parametrize("command", commands())
def test_a_committed_command_is_understood(command: str, parsed: list[Any]) -> None:
    program, *words = shlex.split(command)
    if program == "ugat-marl":
        assert main(words) == 130  # stopped as soon as it was understood
        (made,) = parsed
        if isinstance(getattr(made, "config", None), PaperConfig):  # renamed rows are refused
            rows = [setting.name for setting in made.config.settings(made.table)]
            asked = {PHASE if name == "phase" else name for name in made.config.rows}
            assert rows[0] == "direct transfer" and asked <= set(rows)
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
