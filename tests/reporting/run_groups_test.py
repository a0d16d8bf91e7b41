"""Trainings that differ in more than their seed are no seeds of one setting."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ugat_marl.reporting.run_groups import job_labels, seeds_of_one
from ugat_marl.reporting.run_records import RunRecord


def job(
    seed: int, learner: str = "dqn", episodes: int = 40, hidden: int = 48, **options: Any
) -> RunRecord:
    settings = {
        "scenario": "single-v1",
        "seed": seed,
        "name": "direct transfer",
        "learner": {"name": learner, "settings": [], "dqn": {"hidden": [hidden]}},
        "episodes": episodes,
        "options": options,
    }
    return RunRecord(
        "job", Path(), True, settings, {}, {}, None, None, None, None, (), float("nan")
    )


def test_seeds_of_one_training_are_together() -> None:
    records = [job(0), job(1), job(2)]
    assert seeds_of_one(records) == [records]
    assert job_labels(records) == ["direct transfer"] * 3


def test_learner_episodes_and_options_part_trainings() -> None:
    records = [job(0), job(1), job(0, "sb3-ppo"), job(0, episodes=200), job(0, duration_s=600)]
    assert [len(part) for part in seeds_of_one(records)] == [2, 1, 1, 1]
    labels = job_labels(records)
    assert labels[:2] == ["direct transfer"] * 2
    assert labels[2] == "direct transfer (learner sb3-ppo)"
    assert labels[3] == "direct transfer (episodes 200)"
    assert labels[4] == "direct transfer (options.duration_s 600)"


def test_settings_of_the_suites_learners_part_trainings() -> None:
    records = [job(0), job(1), job(0, hidden=8)]
    assert [len(part) for part in seeds_of_one(records)] == [2, 1]
    assert job_labels(records)[2] == "direct transfer (dqn.hidden [8])"
