"""The commands of the tutorial exist, with the options it gives them; tests/nightly runs them."""

from __future__ import annotations

import importlib
import re
import shlex
from pathlib import Path

import pytest
import tyro

from ugat_marl.__main__ import COMMANDS

PAGE = Path(__file__).parents[2] / "docs" / "tutorials" / "first-city.md"
BLOCKS = re.findall(r"```sh\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
LINES = "".join(BLOCKS).replace("\\\n", " ").splitlines()


def test_the_tutorial_has_commands() -> None:
    assert len(BLOCKS) >= 4
    assert len(LINES) >= 8
    assert all(line.startswith("ugat-marl ") for line in LINES)


@pytest.mark.parametrize("line", LINES)
def test_a_command_of_the_tutorial_can_be_given(line: str) -> None:
    words = shlex.split(line)[1:]
    size = 2 if " ".join(words[:2]) in COMMANDS else 1
    module, _, name = COMMANDS[" ".join(words[:size])][0].partition(":")
    kind = getattr(importlib.import_module(module), name)
    tyro.cli(kind, args=words[size:])  # leaves the test with an error where it cannot
