"""The examples of searches run, where their libraries are installed."""

from __future__ import annotations

import ast
import inspect
import re
import subprocess
from pathlib import Path

import pytest

import ugat_marl

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "how-to"
EXAMPLES = sorted((FOLDER / "sweeps").glob("*.py"))
NEEDS = {"with_optuna": "optuna", "with_ray_tune": "ray.tune"}


def test_every_example_is_on_the_page() -> None:
    page = (FOLDER / "sweeps.md").read_text(encoding="utf-8")
    assert {example.stem for example in EXAMPLES} == {*NEEDS}
    assert all(f"sweeps/{example.name}" in page for example in EXAMPLES)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_uses_the_public_functions_alone(example: Path) -> None:
    """Without its library, at least every keyword must be one that the function takes."""
    tree = ast.parse(example.read_text(encoding="utf-8"))
    imported = [node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    assert not [name for name in imported if name and name.startswith("ugat_marl")]
    calls = 0
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and (
            match := re.fullmatch(r"ugat_marl\.(train|evaluate)", ast.unparse(node.func))
        ):
            taken = inspect.signature(getattr(ugat_marl, match[1])).parameters
            assert {word.arg for word in node.keywords} <= set(taken)
            calls += 1
    assert calls == 2


@pytest.mark.slow
@pytest.mark.timeout(900)  # two trainings
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs(example: Path, python: list[str], tmp_path: Path) -> None:
    pytest.importorskip(NEEDS[example.stem])
    budget = ["--trials", "2", "--episodes", "1", "--duration-s", "120"]
    done = subprocess.run(
        [*python, str(example), *budget, "--out", str(tmp_path / "runs")],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert re.search(r"best travel time \d+\.\d s with .*learning_rate", done.stdout)
