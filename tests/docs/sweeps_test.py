"""The examples of searches run, where their libraries are installed."""

from __future__ import annotations

import ast
import contextlib
import inspect
import re
import subprocess
import sys
import types
from pathlib import Path

import pytest

import ugat_marl
from ugat_marl.data import LogCallback
from ugat_marl.experiments import GROUNDED_NAME
from ugat_marl.experiments.jobs import file_name

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
    assert "tempfile.mkdtemp" in ast.unparse(tree), "two calls must not meet in one folder"


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_asks_for_a_policy_that_its_training_leaves(example: Path) -> None:
    text = example.read_text(encoding="utf-8")
    (grounding,) = re.findall(r'grounding="(\w+)"', text)
    (policy,) = re.findall(r'run\.policies\["([^"]+)"\]', text)
    assert policy == file_name(GROUNDED_NAME[grounding])


@pytest.mark.slow
@pytest.mark.timeout(900)  # two trainings
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs(example: Path, python: list[str], tmp_path: Path) -> None:
    pytest.importorskip(NEEDS[example.stem], exc_type=ImportError)
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


@pytest.mark.parametrize("logger", ["wandb", "mlflow"])
def test_a_logger_gets_names_that_it_takes(logger: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The example on the page, with a logger in place of the library and of the training."""
    page = (FOLDER / "sweeps.md").read_text(encoding="utf-8")
    (example,) = re.findall(rf"```python\n(import {logger}\n.*?)```", page, flags=re.DOTALL)
    logged: dict[str, float] = {}
    library = types.SimpleNamespace(
        init=lambda **_: None,
        log=logged.update,
        start_run=contextlib.nullcontext,
        log_metrics=lambda metrics, step: logged.update({**metrics, "step": step}),
    )

    def train(*_: str, real: str, callback: LogCallback) -> None:
        numbers = {"effects/headway": 1.2, "effects/headway/low": 1.0}
        callback("iteration", 1, numbers)
        callback("evaluation", 20, {f"rule max-pressure:20/{real}/att_s": 98.2})

    monkeypatch.setitem(sys.modules, logger, library)
    monkeypatch.setattr(ugat_marl, "train", train)
    exec(example, {})  # the page's own words
    names = [name for name in logged if name not in ("step", "iteration", "evaluation")]
    assert len(names) == 3
    if logger == "mlflow":  # its store of files has a file for each name
        assert all(re.fullmatch(r"[/\w.\- :]+", name) for name in names)
        assert not [name for name in names if any(n.startswith(f"{name}/") for n in names)]
