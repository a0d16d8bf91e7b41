"""The command that measures the learners: what is trained once, and what a failure looks like."""

from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.experiments import Curve, Training
from ugat_marl.experiments.learning_curves import made_now
from ugat_marl.policies import BASELINES
from ugat_marl.policies.learners.catalogue import baselines_folder
from ugat_marl.progress import Silent

FILE = baselines_folder() / "results.py"
if not FILE.is_file():
    pytest.skip("baselines/ is neither here nor in the package", allow_module_level=True)
spec = importlib.util.spec_from_file_location("baselines_results", FILE)
assert spec is not None and spec.loader is not None
results: Any = importlib.util.module_from_spec(spec)
sys.modules[spec.name] = results  # dataclasses look their module up
spec.loader.exec_module(results)


def test_all_learners_have_a_seed_before_one_has_two() -> None:
    plan = results.Results(seeds=2).plan("single-v1")
    names = ["dqn", *BASELINES]
    assert [one.learner for one in plan] == names * 2
    assert [one.seed for one in plan] == [0] * len(names) + [1] * len(names)
    with pytest.raises(OptionError, match="seeds = 0"):
        results.Results(seeds=0)
    with pytest.raises(UnknownNameError, match="sb3-pp"):
        results.Results(learners=("sb3-pp",))


def test_what_is_there_is_not_trained_again_and_failures_are_told(tmp_path: Path) -> None:
    done = Training("single-v1", "ippo", 0, 2, 2, 1)
    now = made_now("single-v1", "ippo")
    Curve(now, {2: [80.0]}, 1, 1.0).write(tmp_path / done.name)
    other = replace(done, seed=2)
    Curve({**now, "settings": {}}, {2: [80.0]}, 1, 1.0).write(tmp_path / other.name)
    broken = replace(done, scenario=str(tmp_path / "nowhere.sumocfg"), seed=1)
    lines = results.perform_all([done, broken, other], tmp_path, 2, Silent())
    assert len(lines) == 2
    assert lines[0].startswith("nowhere-ippo-s1: exit code 2: ") and "nowhere" in lines[0][30:]
    assert lines[1].startswith("single-v1-ippo-s2: ") and "was made with settings {}" in lines[1]
    assert not (tmp_path / done.name / "job.json").exists()


def test_rules_are_played_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = results.load("single-v1").with_duration(60)
    monkeypatch.setattr(results, "tuned_rules", lambda *_, **__: {"sim": "largest-queue:20"})
    given = results.Results(runs=tmp_path, evaluation_seeds=1, rule_budget=2)
    att_s, best = given.rules(scenario, Silent())
    assert best == "largest-queue:20" and list(att_s)[::2] == ["programme", best]
    assert list(att_s)[1].startswith("fixed-time:")
    assert all(len(values) == 1 and 0 < values[0] < 60 for values in att_s.values())
    monkeypatch.setattr(results, "tune", None)
    assert given.rules(scenario, Silent()) == (att_s, best)
    (file,) = tmp_path.glob("*.json")
    told = json.loads(file.read_text())
    file.write_text(json.dumps(told | {"made_with": []}))
    with pytest.raises(TypeError):  # it would tune again
        given.rules(scenario, Silent())
