"""Scores over policies, domains and seeds: arithmetic by hand, and real episodes."""

from __future__ import annotations

import copy
import json
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ugat_marl
from ugat_marl.data import Scores
from ugat_marl.effects import load_scenario
from ugat_marl.envs import parallel_env
from ugat_marl.errors import CheckpointError, OptionError, UnknownNameError
from ugat_marl.experiments import Evaluation, best_rule, evaluation_of, policy_factory, rule_factory
from ugat_marl.experiments.evaluation import Result, TrainedPolicy
from ugat_marl.policies import DQN, DQNConfig, NamedRule, export_policy
from ugat_marl.simulation import host

BASE = Scores(100.0, 90.0, 500.0, -3.0, 3.0, 0.4, 50.0, 520.0, 515.0, 5.0)


def scores(att_s: float) -> Scores:
    return replace(BASE, att_s=att_s)


@pytest.fixture
def found() -> Evaluation:
    table = {
        ("slow", "sim"): (100.0, 110.0),
        ("slow", "V4"): (150.0, 170.0),
        ("fast", "sim"): (90.0, 94.0),
        ("fast", "V4"): (130.0, 140.0),
    }
    results = tuple(
        Result(policy, domain, seed, scores(value))
        for (policy, domain), values in table.items()
        for seed, value in enumerate(values)
    )
    return Evaluation("toy", "0", results, {})


def test_gap_is_paired_by_seed_and_regret_is_against_the_best_there(found: Evaluation) -> None:
    assert found.policies == ["slow", "fast"]
    assert found.estimate("slow", "sim", "att_s").mean == 105.0
    assert found.gap("slow", "V4", "att_s").mean == 55.0
    assert found.regret("slow", "V4").mean == 25.0
    assert found.estimate("slow", "V4", "att_s").median == 160.0
    assert found.regret("fast", "V4").mean == 0.0
    gap = found.gap("slow", "V4", "att_s")  # the two differences are 50 and 60
    half = 12.7062 * 5  # t of one degree of freedom, and the error of the mean
    assert (gap.low, gap.high) == pytest.approx((55 - half, 55 + half), abs=1e-3)


def test_a_single_seed_has_no_interval(found: Evaluation) -> None:
    single = Evaluation("toy", "0", tuple(r for r in found.results if r.seed == 0), {})
    estimate = single.estimate("slow", "V4", "att_s")
    assert estimate.mean == 150.0
    assert np.isnan(estimate.low)


def test_everything_is_written(found: Evaluation, tmp_path: Path) -> None:
    found.write(tmp_path / "table.json")
    content = json.loads((tmp_path / "table.json").read_text())
    assert len(content["episodes"]) == 8
    row = next(r for r in content["summary"] if (r["policy"], r["domain"]) == ("slow", "V4"))
    assert row["att_s_gap"]["mean"] == 55.0
    assert row["regret_s"]["mean"] == 25.0
    single = Evaluation("toy", "0", found.results[:1], {})
    single.write(tmp_path / "table.json")  # without an interval
    assert '"low": null' in (tmp_path / "table.json").read_text()


def test_how_many_run_at_once_changes_nothing() -> None:
    scenario = load_scenario("single-v1")
    policies = {rule: rule_factory(rule) for rule in ("largest-queue:20", "random", "programme")}
    one, two = (
        evaluation_of(scenario, policies, ["sim", "V4"], [5, 6], duration_s=200, workers=workers)
        for workers in (1, 2)
    )
    assert one.results == two.results
    assert one.domains == ["sim", "V4"]


class Remembering:
    """A policy that goes on counting where nothing tells it that an episode begins."""

    def __init__(self) -> None:
        self.decisions = 0

    def act(self, observations: dict[str, Any]) -> dict[str, int]:
        self.decisions += 1
        return dict.fromkeys(observations, self.decisions // 7 % 4)


def test_a_policy_with_a_memory_plays_the_same_however_many_run_at_once() -> None:
    one, two = (
        ugat_marl.evaluate(
            "single-v1", {"own": Remembering()}, ["sim"], seeds=4, duration_s=150, workers=workers
        )
        for workers in (1, 2)
    )
    assert one.equals(two)


def test_simulations_of_an_evaluation_have_one_warm_parent() -> None:
    """Without it each episode loads SUMO again, which takes as long as the episode."""
    before, blocks = host._WarmParent._blocks, list[int]()

    def make(env: Any) -> Any:
        blocks.append(host._WarmParent._blocks)
        return rule_factory("random")(env)

    evaluation_of(load_scenario("single-v1"), {"own": make}, ["sim"], [1], duration_s=20, workers=1)
    assert blocks and min(blocks) == before + 1


def test_the_best_rule_is_the_one_with_the_smallest_travel_time() -> None:
    scenario = load_scenario("single-v1")
    rules = ("random", "largest-queue:20")
    best = best_rule(scenario, "sim", rules=rules, seeds=[1], duration_s=600)
    assert best == "largest-queue:20"


def test_a_wrong_name_is_refused_before_anything_runs() -> None:
    scenario = load_scenario("single-v1")
    with pytest.raises(UnknownNameError, match="V4"):
        evaluation_of(scenario, {"r": rule_factory("random")}, ["sim", "V44"], [1])
    with pytest.raises(UnknownNameError, match="largest-queue"):
        policy_factory("largest-que:20")


def test_a_rule_is_the_rule_whatever_files_there_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("max-pressure").mkdir()
    assert policy_factory("max-pressure") == rule_factory("max-pressure")
    with pytest.raises(CheckpointError, match="is a folder"):
        policy_factory("./max-pressure")


def test_a_rule_that_a_training_with_a_learner_of_ones_own_kept(tmp_path: Path) -> None:
    NamedRule("largest-queue:20", parallel_env("single-v1")).save(tmp_path / "fitted-street.pt")
    kept = policy_factory(f"my_algo:MyLearner@{tmp_path}/fitted-street.pt")
    assert kept == rule_factory("largest-queue:20")


def test_a_file_of_python_is_given_with_the_name_in_it(tmp_path: Path) -> None:
    (tmp_path / "mine.py").touch()
    with pytest.raises(OptionError, match=r"give the name in it, .*mine\.py:NAME$"):
        policy_factory(str(tmp_path / "mine.py"))


def test_a_policy_of_another_scenario_is_refused(tmp_path: Path) -> None:
    learner = DQN.of(parallel_env("grid2x2-v1"))
    learner.policy().save(tmp_path / "policy.pt")
    factory = policy_factory(str(tmp_path / "policy.pt"))
    with pytest.raises(CheckpointError, match="other intersections than those of scenario"):
        evaluation_of(load_scenario("single-v1"), {"p": factory}, ["sim"], [1], duration_s=100)


def test_a_policy_of_other_movements_is_refused_and_one_of_other_intervals_is_noted() -> None:
    scenario = load_scenario("single-v1")
    env = parallel_env(scenario, observation="movements")
    policy = DQN.of(env, DQNConfig(network="universal", hidden=(4, 4))).policy()
    (junction,) = policy.structure.junctions
    mirrored = copy.copy(policy)
    mirrored.structure = replace(
        policy.structure, junctions=(replace(junction, movements=junction.movements[::-1]),)
    )
    with pytest.raises(CheckpointError, match="movements, phases or neighbours are others"):
        TrainedPolicy(mirrored, "p.pt")(env)
    with pytest.raises(OptionError, match="movements, phases or neighbours are others"):
        export_policy(mirrored, "p.npz", env)
    slow = parallel_env(scenario.with_control(yellow_s=4.0, min_green_s=6.0))
    fast = parallel_env(scenario.with_control(decision_interval_s=5.0))
    make = TrainedPolicy(policy, "p.pt")
    with warnings.catch_warnings(action="error"):  # other clearances are evaluated on purpose
        assert make(env) is make(slow) is policy
    with pytest.warns(UserWarning, match="p.pt .*every 10 s; scenario 'single-v1' .* every 5 s"):
        assert make(fast) is policy
    with pytest.raises(OptionError, match="every 10 s, the environment takes one every 5 s"):
        export_policy(policy, "p.npz", parallel_env(fast.scenario, **policy.env_options))


def test_a_trained_policy_is_played_from_its_file(tmp_path: Path) -> None:
    learner = DQN.of(parallel_env("single-v1"))
    learner.policy().save(tmp_path / "policy.pt")
    found = evaluation_of(
        load_scenario("single-v1"), {"p": policy_factory(str(tmp_path / "policy.pt"))}, ["sim"],
        [1], duration_s=100,
    )  # fmt: skip
    assert found.results[0].scores.due > 0


def test_a_seed_that_is_given_twice_is_refused() -> None:
    with pytest.raises(OptionError, match="a seed is given twice"):
        ugat_marl.evaluate("single-v1", ["random"], ["sim"], seeds=[5, 6, 5], duration_s=60)


def test_seeds_may_be_an_array() -> None:
    table = ugat_marl.evaluate(
        "single-v1", ["random"], ["sim"], seeds=np.arange(5, 7), duration_s=60, workers=1
    )
    assert table["episodes"].to_list() == [2]
