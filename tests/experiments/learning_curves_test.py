"""Learning curves: what is trained, in what order, and the page that tells of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ugat_marl.experiments.learning_curves as module
from tests.runs import perform_in_this_process
from ugat_marl.data import Scores
from ugat_marl.effects import load_scenario
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.experiments import (
    RULE,
    Curve,
    CurvesConfig,
    JobRecord,
    LearningCurves,
    file_stem,
    learn_curves,
    record_of,
)
from ugat_marl.policies import BASELINES
from ugat_marl.progress import Silent
from ugat_marl.reporting import curves_as_csv, curves_page

CONFIG = CurvesConfig(learners=("ippo", "dqn"), seeds=2, episodes=4, evaluate_every=2)
FACTS = {
    "command": "results.py --seeds 2",
    "cpu": "abacus",
    "python": "3.11",
    "versions": {"torch": "2"},
    "date": "2026-01-02T03:04",
}


def curve(learner: str, seed: int, *att_s: float, speed: float = 10.0) -> Curve:
    library = "wonder 1.0" if learner == "ippo" else ""
    return Curve(learner, library, seed, dict(zip((2, 4), att_s, strict=True)), speed, 5.0)


def test_a_curve_by_hand() -> None:
    one = Curve("dqn", "", 0, {5: 200.0, 6: 100.0, 8: 104.0, 9: 112.0})
    assert (one.final_s, one.best_s) == (112.0, 100.0)
    assert one.mean_of_last_s(3) == pytest.approx((100 + 104 + 112) / 3)


def test_a_curve_is_the_means_of_a_record() -> None:
    scenario = load_scenario("single-v1").with_duration(100)
    job = CONFIG.trainings("single-v1")[0]
    scores = Scores(1, 1, 1, 1, 1, 1, 1, 1, 1, 1)
    played = {
        (mark, "sim", seed): replace(scores, att_s=float(mark + seed))
        for mark in job.marks
        for seed in job.evaluation_seeds
    }
    found = Curve.of(job, JobRecord(played, episodes=4, seconds=2.0, own_seconds=1.0), scenario)
    assert found.att_s == {2: 1004.0, 4: 1006.0}  # seeds 1000 to 1004
    assert found.speed == 4 * scenario.decisions / 2
    assert found.own_ms == 1000 / (4 * scenario.decisions)
    short = replace(job, options={**job.options, "duration_s": 50.0})
    half = Curve.of(short, JobRecord(played, episodes=4, seconds=2.0, own_seconds=1.0), scenario)
    assert (half.speed, half.own_ms) == (found.speed / 2, 2 * found.own_ms)


def test_all_learners_have_a_seed_before_one_has_two() -> None:
    plan = CurvesConfig(seeds=2).trainings("single-v1")
    names = ["dqn", "universal", *BASELINES]
    assert [job.setting.name for job in plan] == names * 2
    assert [job.seed for job in plan] == [0] * len(names) + [1] * len(names)
    with pytest.raises(OptionError, match="seeds = 0"):
        CurvesConfig(seeds=0)
    with pytest.raises(UnknownNameError, match="sb3-pp"):
        CurvesConfig(learners=("sb3-pp",))


def test_names_of_scenarios_are_parts_of_names_of_files() -> None:
    assert file_stem("resco:cologne3") == "resco-cologne3"
    assert file_stem("/there/mine.sumocfg") == "mine"
    here = Path.cwd()
    assert file_stem(".") == file_stem(str(here)) and file_stem("..") == file_stem(str(here.parent))


def test_the_page_by_hand() -> None:
    # seeds 3 and 4 end with 120 and 140, 150 is fixed time; their best are 120 and 90
    curves = (
        curve("ippo", 3, 300.0, 120.0, speed=10.0),
        curve("ippo", 4, 90.0, 140.0, speed=30.0),
        curve("dqn", 3, 500.0, 400.0),
    )
    rules = {"programme": 200.0, "fixed-time:30": 150.0, "sotl": 125.0}
    found = LearningCurves("single-v1", "sim", curves, rules, "sotl", {})
    lines = curves_page(found, CONFIG, FACTS).splitlines()
    table = lines[next(i for i, line in enumerate(lines) if line.startswith("| learner")) :]
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table if "| " in line]
    half = 12.706 * np.std([120, 140], ddof=1) / np.sqrt(2)
    assert cells[1][:5] == ["ippo", "wonder 1.0", "2", "20", "5.0"]
    assert (
        cells[1][5].startswith("105 (")
        and cells[1][6] == f"130 ({130 - half:.1f}–{130 + half:.0f})"
    )
    assert cells[1][7:] == ["-20.0", "2 of 2", "1 of 2"]
    assert cells[2][5:] == ["400", "400", "250", "0 of 1", "0 of 1"]
    assert [row[0] for row in cells[3:]] == [
        "*programme*",
        "*fixed-time:30*",
        "*sotl* (best tuned rule)",
    ]
    assert [row[6] for row in cells[3:]] == ["200", "150", "125"]
    assert "results.py --seeds 2" in lines
    failed = curves_page(LearningCurves("single-v1", "sim", curves, {}, "", {}), CONFIG, FACTS)
    assert "| - | - | - |" in failed, "no rule was played to its end"
    rows = curves_as_csv(curves).splitlines()
    assert len(rows) == 1 + 3 * 2 and rows[2] == "ippo,wonder 1.0,3,4,120.0,10.0,5.0"


@pytest.mark.slow
def test_what_is_there_is_not_trained_again_and_failures_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    perform_in_this_process(monkeypatch)
    short = replace(CONFIG, seeds=1, episodes=1, evaluation_seeds=1, rule_budget=2, duration_s=60.0)
    scenario = load_scenario("single-v1").with_duration(60)
    found = learn_curves(scenario, "single-v1", short, tmp_path, 2, Silent())
    assert not found.failures and [own.learner for own in found.curves] == ["ippo", "dqn"]
    programme, fixed, *_ = found.rules
    assert programme == "programme" and fixed.startswith("fixed-time:")
    assert found.best in found.rules and all(0 < att_s < 60 for att_s in found.rules.values())
    best = next(job for job in short.rules("single-v1") if job.setting.name == RULE)
    record = record_of(best, tmp_path)
    assert record is not None
    assert found.rules[found.best] == record.scores[0, "sim", 1000].att_s
    files = list(tmp_path.glob("*/scores.json"))
    times = [path.stat().st_mtime_ns for path in files]
    assert len(files) == 5

    def refused(job: object, failures: dict[str, str]) -> bool:
        failures["ippo"] = "is not installed"
        return job is not short.trainings("single-v1")[0]

    monkeypatch.setattr(module, "_can_be_made", refused)
    again = learn_curves(scenario, "single-v1", short, tmp_path, 2, Silent())
    assert again.rules == found.rules and again.failures == {"ippo": "is not installed"}
    assert [path.stat().st_mtime_ns for path in files] == times
