"""The check of words catches what it is for, and lets plain prose pass."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

FILE = Path(__file__).resolve().parents[2] / ".ci" / "words.py"
spec = importlib.util.spec_from_file_location("words", FILE)
assert spec is not None and spec.loader is not None
words = importlib.util.module_from_spec(spec)
spec.loader.exec_module(words)


@pytest.mark.parametrize("opening", ["What", "Whether", "How", "Of", "As", "If", "Where", "Which"])
def test_a_docstring_that_opens_with_a_riddle_is_caught(opening: str) -> None:
    source = f'"""A module."""\n\n\ndef f():\n    """{opening} it is."""\n'
    assert list(words.docstring_faults(source, "m.py")) == [
        f"m.py:4: the docstring opens with {opening!r}"
    ]


@pytest.mark.parametrize("opening", ["Return it.", "Trips of a day.", "Offset.", "Where-clause."])
def test_a_plain_docstring_passes(opening: str) -> None:
    assert not list(words.docstring_faults(f'"""{opening}"""\n', "m.py"))


def test_a_long_line_of_prose_is_caught_and_a_long_row_of_a_table_is_not() -> None:
    assert len(list(words.page_faults("word " * 70, "p.md"))) == 1
    assert not list(words.page_faults("| " + "word " * 70 + "|", "p.md"))
    assert not list(words.page_faults("```\n" + "word " * 70 + "\n```\n", "p.md"))


def test_many_numbers_in_a_paragraph_are_caught() -> None:
    assert len(list(words.page_faults("1 and 2,\n3.5 and 4,\n5 % and 6 s\n", "p.md"))) == 1
    assert not list(words.page_faults("1 and 2, 3.5 and 4, 5 %\n\n6 s\n", "p.md"))
    assert not list(words.page_faults("- 1, 2, 3\n- 4, 5, 6\n", "p.md"))
    assert not list(words.page_faults("V1 V2 V3 V4 single-v1 4x4 `1 2 3 4 5 6`\n", "p.md"))
