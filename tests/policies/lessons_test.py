"""Lessons: the choice of a teacher, what a learner takes from it, and the run that goes on."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ugat_marl.envs import TrafficEnv, frame_stack, parallel_env
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.policies import (
    DQN,
    STANDARD_RULES,
    UNIVERSAL_NAME,
    DQNConfig,
    Taught,
    make_rule,
    observed_options,
    roll_out,
    suite_config,
)
from ugat_marl.policies.learners.lessons import BEST, find_teacher, plays
from ugat_marl.seeding import derive_seed

RULE = "largest-queue:20"
SETTINGS = replace(
    suite_config(UNIVERSAL_NAME), teacher=RULE, lessons=1, lesson_updates=600, warmup_decisions=20
)


@pytest.fixture(scope="module")
def env() -> Iterator[TrafficEnv]:
    options = observed_options(UNIVERSAL_NAME)
    with contextlib.closing(parallel_env("single-v1", duration_s=400, **options)) as made:
        yield made


def agreement(learner: DQN, env: TrafficEnv) -> float:
    """Share of decisions in which the learner's policy chooses as the teacher, who acts."""
    policy, teacher = learner.policy(), make_rule(RULE, env)
    observations, infos = env.reset(seed=77)
    teacher.reset(77)
    same: list[bool] = []
    while env.agents:
        actions = teacher.act(observations, infos)
        same += [policy.act(observations, infos)[agent] == actions[agent] for agent in actions]
        observations, _, _, _, infos = env.step(actions)
    return float(np.mean(same))


def test_a_best_rule_that_is_known_teaches_where_the_best_one_is_asked_for(
    env: TrafficEnv,
) -> None:
    learner = DQN.of(env, replace(SETTINGS, teacher=BEST, lesson_updates=1), 0)
    assert learner.plays(env, RULE) == 1
    assert learner.attend(env, 0, best=RULE) == RULE
    named = DQN.of(env, replace(SETTINGS, lesson_updates=1), 0)
    assert named.attend(env, 0, best="max-pressure:10") == RULE


def test_where_no_rule_reads_the_observations_there_are_no_lessons() -> None:
    """All standard rules read `movements`, and the default learner other observations as well."""
    options = observed_options(UNIVERSAL_NAME) | {"observation": "count"}
    with contextlib.closing(parallel_env("single-v1", duration_s=100, **options)) as env:
        learner = DQN.of(env, replace(SETTINGS, teacher=BEST), 0)
        assert learner.plays(env) == 0
        assert learner.attend(env, 0) is None
        learner.learn(env, 1, 0)
        assert learner.episodes == 1
        asked = DQN.of(env, DQNConfig(teacher=BEST), 0)
        for lessons in (asked.plays, lambda env: asked.attend(env, 0)):
            with pytest.raises(OptionError, match="best: no standard rule .* --observation movem"):
                lessons(env)
        named = DQN.of(env, SETTINGS, 0)
        with pytest.raises(OptionError, match="train in such ones, or leave the teacher out"):
            named.attend(env, 0)


def test_no_rule_teaches_where_observations_are_stacked(env: TrafficEnv) -> None:
    stacked = frame_stack(env, 3)
    learner = DQN.of(stacked, replace(SETTINGS, network="mlp", teacher=BEST), 0)
    with pytest.raises(OptionError, match="not stacked"):
        learner.plays(stacked)


def test_a_learner_acts_as_its_teacher_before_its_first_episode(env: TrafficEnv) -> None:
    learner = DQN.of(env, SETTINGS, 0)
    assert isinstance(learner, Taught)
    untaught = agreement(learner, env)
    assert learner.attend(env, 0) == RULE
    assert learner.episodes == 0
    assert agreement(learner, env) > max(0.8, untaught + 0.2)


def test_lessons_and_decisions_have_one_scale() -> None:
    """What was learnt in the lessons would be forgotten if its inputs changed their size."""
    settings = DQNConfig(teacher=RULE, lessons=1, lesson_updates=600, warmup_decisions=20)
    with contextlib.closing(
        parallel_env("single-v1", duration_s=400, observation="movements")
    ) as env:
        learner = DQN.of(env, settings, 0)
        learner.attend(env, 0)
        taught = {name: value.clone() for name, value in learner._tensors().items()}
        assert (learner._inputs > 1.5).any()
        learner.learn(env, 1, 0)
        assert learner.decisions > settings.warmup_decisions
    for name in ("inputs", "centre", "scale"):
        assert torch.equal(learner._tensors()[name], taught[name])


@pytest.mark.slow
def test_the_best_of_the_standard_rules_is_found(env: TrafficEnv) -> None:
    heard: list[str] = []
    name, teacher = find_teacher(env, BEST, 3, heard.append)
    seeds = [derive_seed(3, "teacher", episode) for episode in range(3)]
    found = np.mean([roll_out(env, teacher, seed).mean_reward for seed in seeds])
    for rival in ("max-pressure:10", "largest-queue:40", "webster:1500"):
        rule = make_rule(rival, env)
        assert found >= np.mean([roll_out(env, rule, seed).mean_reward for seed in seeds])
    assert name in heard
    assert len(heard) == plays(BEST, 0, env)


def test_rules_that_read_something_else_do_not_teach(env: TrafficEnv) -> None:
    heard: list[str] = []
    find_teacher(env, BEST, 0, heard.append)
    assert "programme" in STANDARD_RULES
    assert "programme" not in heard
    with pytest.raises(OptionError, match=r"teacher longest-waiting: it needs .*waiting"):
        find_teacher(env, "longest-waiting", 0)
    with pytest.raises(UnknownNameError):
        find_teacher(env, "nobody", 0)


def test_lessons_come_once_by_themselves_and_again_when_asked(env: TrafficEnv) -> None:
    short = replace(SETTINGS, lesson_updates=1)
    learner = DQN.of(env, short, 0)
    learner.learn(env, 1, 0)
    learner.learn(env, 1, 0)
    assert learner.taught == 1
    shown = learner._replay.rows(learner._replay.added)["shown"]
    decisions = len(learner._replay) // 3
    assert shown[0].sum() == decisions  # one lesson and two episodes
    assert shown[0, :decisions].all()
    learner.attend(env, 0)
    shown = learner._replay.rows(learner._replay.added)["shown"]
    assert shown[0].sum() == decisions  # the first lesson is an example no more
    assert shown[0, -decisions:].all()
    assert learner.plays(env) == 1
    assert DQN.of(env, replace(short, teacher=None), 0).plays(env) == 0


def test_a_run_that_goes_on_after_lessons_equals_an_unbroken_one(
    env: TrafficEnv, tmp_path: Path
) -> None:
    short = replace(SETTINGS, lesson_updates=20)
    whole = DQN.of(env, short, 0)
    whole.learn(env, 2, 0)
    first = DQN.of(env, short, 0)
    first.learn(env, 1, 0)
    first.save(tmp_path / "learner.pt")
    second = DQN.of(env, short, 5)
    second.load(tmp_path / "learner.pt")
    second.learn(env, 1, 0)
    assert np.array_equal(whole.policy().parameters, second.policy().parameters)


def test_margin_losses_are_those_of_the_paper(env: TrafficEnv) -> None:
    learner = DQN.of(env, replace(SETTINGS, margin=0.5), 0)
    values = torch.full((1, 2, learner.agents.most_actions), -9.0)
    values[0, 0, :3] = torch.tensor([1.0, 1.2, -3.0])
    values[0, 1, :3] = torch.tensor([2.0, 1.0, 1.4])
    action = torch.tensor([[0, 0]])
    chosen = values.gather(-1, action.unsqueeze(-1)).squeeze(-1)
    losses = learner._margin_losses(values, action, chosen)
    # max(1, 1.2 + 0.5, ...) - 1, and nothing where the teacher's action leads by more
    torch.testing.assert_close(losses, torch.tensor([[0.7, 0.0]]))


def test_exploration_begins_at_its_end_with_a_teacher() -> None:
    assert DQNConfig(teacher=BEST).epsilon(0, taught=True) == DQNConfig().epsilon_end
    assert DQNConfig(teacher=BEST).epsilon(0, taught=False) == DQNConfig().epsilon_start
