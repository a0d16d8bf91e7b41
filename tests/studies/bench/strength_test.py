"""`bench strength`: its arithmetic by hand, and once at its smallest."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from studies.bench.strength import StrengthBench
from ugat_marl.envs import parallel_env
from ugat_marl.errors import OptionError
from ugat_marl.experiments import EVALUATION_SEED as FIRST_SEED
from ugat_marl.experiments import evaluation_of, rule_factory
from ugat_marl.policies import DQN, roll_out
from ugat_marl.policies.learners.dqn import DQNConfig


def test_it_judges_now_and_then_and_at_the_end_after_every_episode() -> None:
    marks = [
        StrengthBench(episodes=n, every=5, last=last).plan[-1].marks
        for n, last in ((20, 3), (2, 10))
    ]
    assert marks == [(5, 10, 15, 18, 19, 20), (1, 2)]


@pytest.mark.slow
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
        learner="dqn",
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
    found = evaluation_of(
        scenario, {rule: rule_factory(rule)}, ["sim"], [FIRST_SEED, FIRST_SEED + 1]
    )
    by_rule = found.estimate(rule, "sim", "att_s").mean  # the scenario is in V4 already
    strong, steady = report.targets
    assert strong.measured == row["/ rule"] == pytest.approx(row["ATT [s]"] / by_rule)
    assert (steady.measured, steady.met) == (1.0, True)
    assert json.loads(out.read_text())["rows"][0]["curve"] == row["curve"]


@pytest.mark.parametrize("option", ["episodes", "every", "last", "evaluation_seeds"])
def test_impossible_settings_are_named(option: str) -> None:
    with pytest.raises(OptionError, match=f"bench strength: {option} = 0"):
        replace(StrengthBench(), **{option: 0})


@pytest.mark.slow
def test_a_named_rule_is_not_searched_for() -> None:
    config = DQNConfig(warmup_decisions=10, batch_size=4)
    bench = StrengthBench(episodes=1, seeds=(1,), evaluation_seeds=1, duration_s=100, dqn=config)
    report = replace(bench, rule="fixed-time:40").run()
    assert report.settings["rule"] == "fixed-time:40"
    assert "best rule" not in report.notes[0]


def test_no_seeds_are_refused() -> None:
    with pytest.raises(OptionError, match="seeds is empty"):
        StrengthBench(seeds=())


def test_another_learner_is_measured_as_well() -> None:
    bench = StrengthBench(episodes=1, seeds=(1,), evaluation_seeds=1, duration_s=100)
    report = replace(bench, rule="fixed-time:40", learner="ippo").run()
    assert "ippo after 1 episodes" in report.notes[0]
