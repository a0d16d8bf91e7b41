"""``baselines/results.py``: its pages, and what a failure looks like."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import pytest

from ugat_marl.errors import OptionError
from ugat_marl.experiments import Curve, CurvesConfig, LearningCurves
from ugat_marl.policies.learners.catalogue import baselines_folder

FILE = baselines_folder() / "results.py"
if not FILE.is_file():
    pytest.skip("baselines/ is neither here nor in the package", allow_module_level=True)
spec = importlib.util.spec_from_file_location("baselines_results", FILE)
assert spec is not None and spec.loader is not None
results: Any = importlib.util.module_from_spec(spec)
sys.modules[spec.name] = results  # dataclasses look their module up
spec.loader.exec_module(results)


def test_impossible_options_are_named(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="jobs = 0"):
        results.Results(jobs=0)
    nowhere = str(tmp_path / "nowhere.sumocfg")
    with pytest.raises(Exception, match="nowhere"):
        results.Results(scenarios=("single-v1", nowhere), runs=tmp_path / "runs").run()
    assert not (tmp_path / "runs").exists()


def test_a_page_and_a_table_are_written_and_failures_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rules = {"programme": 60.0, "fixed-time:30": 55.0, "sotl": 50.0}
    curves = (Curve("dqn", "", 0, {1: 70.0}),)
    found = LearningCurves("single-v1", "sim", curves, rules, "sotl", {"vdn": "needs benchmarl"})
    monkeypatch.setattr(results, "learn_curves", lambda *_: found)
    given = results.Results(("single-v1",), CurvesConfig(episodes=1), out=tmp_path)
    assert given.run() == 1
    assert "vdn: needs benchmarl" in capsys.readouterr().out
    assert "| dqn |" in (tmp_path / "single-v1.md").read_text()
    assert (tmp_path / "single-v1.csv").read_text().count("\n") == 2
    # A table is not replaced by one without some of its learners, whether unasked or not trained.
    page = (tmp_path / "single-v1.md").read_bytes()
    fewer = results.Results(("single-v1",), CurvesConfig(learners=("ippo",)), out=tmp_path)
    with pytest.raises(OptionError, match="has rows of dqn, which would be lost"):
        fewer.run()
    untrained = LearningCurves(
        "single-v1", "sim", (Curve("vdn", "", 0, {1: 7.0}),), rules, "sotl", {}
    )
    monkeypatch.setattr(results, "learn_curves", lambda *_: untrained)
    assert given.run() == 1
    assert "single-v1.md: kept, since it has rows of dqn, which failed" in capsys.readouterr().out
    assert (tmp_path / "single-v1.md").read_bytes() == page
    (tmp_path / "single-v1.csv").write_text("a,b\n1,2\n")
    with pytest.raises(OptionError, match="is no table of results.py"):
        given.run()
