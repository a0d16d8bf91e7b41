"""The notebooks run from their first cell to their last, and their outputs are of a whole run.

The site that shows them is built strictly.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.docs.links import broken_links, local_links

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "notebooks"
BOOKS = sorted(FOLDER.glob("*.ipynb"))

BORDERS = ("shape", "┌", "│", "╞", "└")
"""Beginnings of the lines of a table of polars, whose form is its own affair."""


def cells(book: Path) -> list[dict[str, Any]]:
    return json.loads(book.read_text(encoding="utf-8"))["cells"]


def code(book: Path) -> list[dict[str, Any]]:
    return [cell for cell in cells(book) if cell["cell_type"] == "code"]


def site_builder() -> Any:
    """The module that builds the site."""
    spec = importlib.util.spec_from_file_location("site_builder", FOLDER.parents[1] / ".ci/site.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_there_are_notebooks() -> None:
    assert {book.stem for book in BOOKS} == {"first-environment", "your-street"}


@pytest.mark.parametrize("book", BOOKS, ids=lambda book: book.stem)
def test_a_notebook_runs(book: Path, python: list[str], tmp_path: Path) -> None:
    """Cells without the magic words of notebooks are one program."""
    program = "\n".join("".join(cell["source"]) for cell in code(book))
    assert not [line for line in program.splitlines() if line.startswith(("%", "!"))]
    done = subprocess.run(
        [*python, "-c", program],
        cwd=FOLDER,
        env={**os.environ, "MPLBACKEND": "Agg", "TMPDIR": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    shown = "".join(
        "".join(output["text"])
        for cell in code(book)
        for output in cell["outputs"]
        if output["output_type"] == "stream" and output["name"] == "stdout"
    )
    said = {line for line in shown.splitlines() if not line.startswith(BORDERS)}
    assert said and said <= set(done.stdout.splitlines())


@pytest.mark.parametrize("book", BOOKS, ids=lambda book: book.stem)
def test_outputs_are_of_one_whole_run(book: Path) -> None:
    assert [cell["execution_count"] for cell in code(book)] == list(range(1, len(code(book)) + 1))
    kinds = [output["output_type"] for cell in code(book) for output in cell["outputs"]]
    assert kinds and "error" not in kinds
    assert not [
        output
        for cell in code(book)
        for output in cell["outputs"]
        if output["output_type"] == "stream" and output["name"] == "stderr"
    ]


@pytest.mark.parametrize("book", BOOKS, ids=lambda book: book.stem)
def test_links_of_a_notebook_lead_somewhere(book: Path) -> None:
    texts = ["".join(cell["source"]) for cell in cells(book) if cell["cell_type"] == "markdown"]
    assert local_links("\n".join(texts))
    assert broken_links("\n".join(texts), book) == []


@pytest.mark.parametrize("book", BOOKS, ids=lambda book: book.stem)
def test_the_site_has_a_page_of_a_notebook(book: Path, tmp_path: Path) -> None:
    """The page has every text, every cell and every output; pictures are files beside it."""
    site = site_builder()
    copy = tmp_path / book.name
    copy.write_bytes(book.read_bytes())
    page = site.notebook(copy)
    assert "\x1b" not in page
    assert page.startswith("# ") and page.splitlines()[2].startswith("*This page is the notebook")
    for cell in cells(book):
        source = "".join(cell["source"]).strip()
        assert all(line in page for line in source.splitlines())
    outputs = [output for cell in code(book) for output in cell["outputs"]]
    assert page.count("\n```text\n") + page.count("![Output") == len(outputs)
    pictures = re.findall(r"!\[[^]]+\]\(([^)]+)\)", page)
    assert sorted(pictures) == sorted(path.name for path in tmp_path.glob("*.png"))


@pytest.mark.parametrize("text", ["", "a link leads nowhere"])
def test_a_warning_of_mkdocs_fails_the_site(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """With -q MkDocs hears no warnings, so that --strict finds none."""
    python = tmp_path / "python"
    python.write_text(
        f'#!/bin/sh\ncase "$*" in *-q*) exit 0;; esac\necho "{text}"\n[ -z "{text}" ]\n'
    )
    python.chmod(0o755)
    site = site_builder()
    monkeypatch.setattr(site, "environment", lambda: python)
    monkeypatch.setattr(site, "stage", lambda: None)
    assert site.main() == bool(text)
    told = capfd.readouterr()
    assert text in told.err and ("the site is in" in told.out) == (not text)


def test_a_name_on_two_pages_has_one_address() -> None:
    site, told = site_builder(), set[str]()
    room = site.PACKAGE / "experiments" / "__init__.pyi"
    block = "\n::: ugat_marl.experiments.functions.Training\n"
    again = f"{block}    options:\n      skip_local_inventory: true\n"
    assert again not in (first := site.reference("ugat_marl.experiments", room, told))
    assert block in first
    assert again in site.reference("ugat_marl", site.PACKAGE / "__init__.pyi", told)
