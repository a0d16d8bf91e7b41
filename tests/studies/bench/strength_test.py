"""`bench strength`: its arithmetic by hand, and once at its smallest."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from studies.bench.strength import FIRST_SEED, Curve, StrengthBench
from ugat_marl.envs import parallel_env
from ugat_marl.errors import OptionError
from ugat_marl.experiments import evaluate, rule_factory
from ugat_marl.policies import DQN, roll_out
from ugat_marl.policies.learners.dqn import DQNConfig


def test_a_curve_by_hand() -> None:
    curve = Curve({5: 200.0, 6: 100.0, 8: 104.0, 9: 112.0}, last=3)
    assert (curve.final_s, curve.best_s) == (112.0, 100.0)
    assert curve.mean_of_last_s == pytest.approx((100 + 104 + 112) / 3)
    assert curve.unsteadiness == pytest.approx(1.0533, abs=1e-4)
    assert Curve({1: 50.0, 2: 100.0}, last=1).unsteadiness == 2.0


def test_it_judges_now_and_then_and_at_the_end_after_every_episode() -> None:
    assert StrengthBench(episodes=20, every=5, last=3).judged == [5, 10, 15, 18, 19, 20]
    assert StrengthBench(episodes=2, every=5, last=10).judged == [1, 2]


def test_it_measures_what_training_and_evaluating_by_hand_give(tmp_path: Path) -> None:
    out = tmp_path / "strength.json"
    config = DQNConfig(warmup_decisions=10, batch_size=4)
    report = StrengthBench(
        episodes=2,
        every=2,
        last=1,
        seeds=(10,),
        evaluation_seeds=2,
        tuning_seeds=1,
        duration_s=200,
        domain="V4",
        dqn=config,
        out=out,
    ).run()
    env = parallel_env("single-v1", "V4", duration_s=200)
    policy = DQN.of(env, config, seed=10).learn(env, 2, seed=10)
    times: list[float] = []
    for seed in (FIRST_SEED, FIRST_SEED + 1):
        roll_out(env, policy, seed)
        times.append(env.scores().att_s)
    scenario = env.scenario
    env.close()
    (row,) = report.rows
    assert row["ATT [s]"] == pytest.approx(sum(times) / 2)
    assert row["curve"] == {"2": row["ATT [s]"]}

    rule = report.settings["rule"]
    found = evaluate(scenario, {rule: rule_factory(rule)}, ["sim"], [FIRST_SEED, FIRST_SEED + 1])
    by_rule = found.estimate(rule, "sim", "att_s").mean  # the scenario is in V4 already
    strong, steady = report.targets
    assert strong.measured == row["/ rule"] == pytest.approx(row["ATT [s]"] / by_rule)
    assert (steady.measured, steady.met) == (1.0, True)
    assert json.loads(out.read_text())["rows"][0]["curve"] == row["curve"]


@pytest.mark.parametrize("option", ["episodes", "every", "last", "evaluation_seeds"])
def test_impossible_settings_are_named(option: str) -> None:
    with pytest.raises(OptionError, match=f"bench strength: {option} = 0"):
        replace(StrengthBench(), **{option: 0})


def test_a_named_rule_is_not_searched_for() -> None:
    config = DQNConfig(warmup_decisions=10, batch_size=4)
    bench = StrengthBench(episodes=1, seeds=(1,), evaluation_seeds=1, duration_s=100, dqn=config)
    report = replace(bench, rule="fixed-time:40").run()
    assert report.settings["rule"] == "fixed-time:40"
    assert "best rule" not in report.notes[0]


def test_no_seeds_are_refused() -> None:
    with pytest.raises(OptionError, match="seeds is empty"):
        StrengthBench(seeds=())
