"""Trainings that differ in more than their seed are no seeds of one setting."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

from ugat_marl.reporting.run_groups import job_labels, seeds_of_one
from ugat_marl.reporting.run_records import RunRecord


def job(
    seed: int,
    learner: str = "dqn",
    episodes: int = 40,
    hidden: int = 48,
    digest: str = "0123456789",
    **options: Any,
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
        f"job-{digest}", Path(), True, settings, {}, {}, None, None, None, None, (), math.nan
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
    assert job_labels(records)[2] == "direct transfer (dqn.hidden 8)"


def test_trainings_of_two_versions_are_not_one_setting() -> None:
    labels = job_labels([job(0), job(0, digest="abcdefabcd"), job(1)])
    assert labels == [
        "direct transfer (0123456789)", "direct transfer (abcdefabcd)", "direct transfer",
    ]  # fmt: skip


def a_run(seed: int, **changes: Any) -> RunRecord:
    settings = {"scenario": "single-v1", "seed": seed, "real": "V4", "evaluation_seeds": 5}
    hashes, versions = {"sim": "aaa"}, {"libsumo": "1.28.0", "numpy": "2.0"}
    record = RunRecord(
        f"s{seed}", Path(), False, settings, hashes, versions, None, None, None, None, (), math.nan
    )
    return replace(record, **changes)


def test_runs_in_other_worlds_are_not_seeds_of_one() -> None:
    first, second = a_run(0), a_run(1)
    longer = a_run(2, settings={**first.settings, "seed": 2, "evaluation_seeds": 20})
    newer = a_run(3, versions={"libsumo": "1.29.0", "numpy": "2.0"})
    other = a_run(4, hashes={"sim": "bbb"})
    numpy = a_run(5, versions={"libsumo": "1.28.0", "numpy": "2.1"})
    found = seeds_of_one([first, second, longer, newer, other, numpy])
    assert found == [[first, second, numpy], [longer], [newer], [other]]
