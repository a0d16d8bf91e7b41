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
    with pytest.raises(OptionError, match=r"pages holds one twice: net.md net.md"):
        results.Results(scenarios=("a/net", "b/net"))
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
    # A table is not replaced by one without some of its rows, whether unasked or not trained.
    page = (tmp_path / "single-v1.md").read_bytes()
    fewer = results.Results(("single-v1",), CurvesConfig(learners=("ippo",)), out=tmp_path)
    with pytest.raises(
        OptionError, match="would be lost, such as dqn with seed 0 after 1 episode;"
    ):
        fewer.run()
    untrained = LearningCurves(
        "single-v1", "sim", (Curve("vdn", "", 0, {1: 7.0}),), rules, "sotl", {}
    )
    monkeypatch.setattr(results, "learn_curves", lambda *_: untrained)
    assert given.run() == 1
    assert (
        "single-v1.md: kept, since rows of it failed, such as dqn with seed 0 after 1 episode"
        in capsys.readouterr().out
    )
    assert (tmp_path / "single-v1.md").read_bytes() == page
    (tmp_path / "single-v1.csv").write_text("a,b\n1,2\n")
    with pytest.raises(OptionError, match="is no table of results.py"):
        given.run()


@pytest.mark.parametrize(
    ("fewer", "lost"),
    [
        (CurvesConfig(("dqn",), seeds=1, episodes=4, evaluate_every=2), "seed 1 after 2 episodes"),
        (CurvesConfig(("dqn",), seeds=2, episodes=2, evaluate_every=2), "seed 0 after 4 episodes"),
        (CurvesConfig(("dqn",), seeds=2, episodes=4, evaluate_every=4), "seed 0 after 2 episodes"),
        (CurvesConfig(("dqn",), seeds=3, episodes=6, evaluate_every=2), ""),
    ],
)
def test_a_table_keeps_the_seeds_and_the_evaluations_that_it_has(
    fewer: CurvesConfig, lost: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def trained(_: object, name: str, config: CurvesConfig, *__: object) -> LearningCurves:
        curves = [
            Curve(job.setting.name, "", job.seed or 0, dict.fromkeys(job.marks, 70.0))
            for job in config.trainings(name)
        ]
        return LearningCurves(name, "sim", tuple(curves), {"sotl": 50.0}, "sotl", {})

    monkeypatch.setattr(results, "learn_curves", trained)
    config = CurvesConfig(("dqn",), seeds=2, episodes=4, evaluate_every=2)
    assert results.Results(("single-v1",), config, out=tmp_path).run() == 0
    before = (tmp_path / "single-v1.csv").read_text()
    again = results.Results(("single-v1",), fewer, out=tmp_path)
    if not lost:
        assert again.run() == 0
        assert set(before.splitlines()) < set((tmp_path / "single-v1.csv").read_text().splitlines())
        return
    with pytest.raises(OptionError, match=f"would be lost, such as dqn with {lost};"):
        again.run()
    assert (tmp_path / "single-v1.csv").read_text() == before
