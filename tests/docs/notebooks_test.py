"""The notebooks run from their first cell to their last, and their outputs are of a whole run."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "notebooks"
BOOKS = sorted(FOLDER.glob("*.ipynb"))

BORDERS = ("shape", "┌", "│", "╞", "└")
"""Beginnings of the lines of a table of polars, whose form is its own affair."""


def cells(book: Path) -> list[dict[str, Any]]:
    return json.loads(book.read_text(encoding="utf-8"))["cells"]


def code(book: Path) -> list[dict[str, Any]]:
    return [cell for cell in cells(book) if cell["cell_type"] == "code"]


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
    targets = [target for text in texts for target in re.findall(r"\]\(([^)#]+)\)", text)]
    assert targets
    assert not [name for name in targets if not (book.parent / name).exists()]


@pytest.mark.parametrize("book", BOOKS, ids=lambda book: book.stem)
def test_the_site_has_a_page_of_a_notebook(book: Path, tmp_path: Path) -> None:
    """The page has every text, every cell and every output; pictures are files beside it."""
    spec = importlib.util.spec_from_file_location("site_builder", FOLDER.parents[1] / ".ci/site.py")
    assert spec is not None and spec.loader is not None
    site: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(site)
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
