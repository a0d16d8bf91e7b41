"""The commands of the tutorial exist, with the options it gives them; tests/nightly runs them."""

from __future__ import annotations

import importlib
import re
import shlex
from pathlib import Path

import pytest
import tyro

from ugat_marl.__main__ import COMMANDS

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "docs" / "tutorials" / name for name in ("first-city.md", "your-town.md")]


def blocks(page: Path) -> list[str]:
    return re.findall(r"```sh\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL)


def lines(page: Path) -> list[str]:
    return "".join(blocks(page)).replace("\\\n", " ").splitlines()


LINES = [line for page in PAGES for line in lines(page)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_tutorial_has_commands(page: Path) -> None:
    assert len(blocks(page)) >= 4
    assert len(lines(page)) >= 8
    assert all(line.startswith("ugat-marl ") for line in lines(page))


def test_the_files_of_a_tutorial_are_there() -> None:
    named = {
        word for line in LINES for word in line.split() if word.startswith(("docs/", "tests/"))
    }
    assert len(named) >= 4
    assert all((ROOT / name).exists() for name in named)


@pytest.mark.parametrize("line", LINES)
def test_a_command_of_the_tutorial_can_be_given(line: str) -> None:
    words = shlex.split(line)[1:]
    size = 2 if " ".join(words[:2]) in COMMANDS else 1
    module, _, name = COMMANDS[" ".join(words[:size])][0].partition(":")
    kind = getattr(importlib.import_module(module), name)
    tyro.cli(kind, args=words[size:])  # leaves the test with an error where it cannot
