"""Trainings that differ in more than their seed are no seeds of one setting."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

from ugat_marl.data import Scores
from ugat_marl.experiments import RULE, Evaluation
from ugat_marl.experiments.scores import Result, best_rule_note
from ugat_marl.reporting.run_groups import groups, job_labels, seeds_of_one
from ugat_marl.reporting.run_records import RunRecord


def job(
    seed: int,
    learner: str = "dqn",
    episodes: int = 40,
    hidden: int = 48,
    digest: str = "0123456789",
    control: str | None = None,
    hashes: dict[str, str] | None = None,
    **options: Any,
) -> RunRecord:
    settings = {
        "scenario": "single-v1",
        "seed": seed,
        "name": "direct transfer",
        "learner": {"name": learner, "settings": [], "dqn": {"hidden": [hidden]}},
        "episodes": episodes,
        "options": options,
        "negative_control": control,
    }
    return RunRecord(
        f"job-{digest}",
        Path(),
        True,
        settings,
        hashes or {},
        {},
        None,
        None,
        None,
        None,
        (),
        math.nan,
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


def test_controls_and_other_files_part_trainings() -> None:
    others = job(3, control="same-world"), job(4, hashes={"sim": "a" * 64})
    records = [job(0), job(1), job(2), *others]
    assert [len(part) for part in seeds_of_one(records)] == [3, 1, 1]
    assert job_labels(records)[3:] == [
        "direct transfer (negative_control same-world)", "direct transfer (sim files aaaaaaaaaa)"
    ]  # fmt: skip


def test_jobs_for_two_domains_have_one_name() -> None:
    records = [job(0, hashes={"sim": "a" * 64, "real": name * 64}) for name in "bc"]
    records = [
        replace(one, settings={**one.settings, "target": one.hashes["real"][0]}) for one in records
    ]
    assert job_labels(records) == ["direct transfer"] * 2


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


BASE = Scores(0.0, 90.0, 500.0, -3.0, 3.0, 0.4, 50.0, 520.0, 515.0, 0.0)


def judged(seed: int, travel_time_s: float, written: float, **settings: Any) -> RunRecord:
    """A run with direct transfer, corrected simulation and a best rule."""
    policies = ("direct transfer", "corrected sim", "rule max-pressure:10")
    results = [
        Result(policy, domain, 5, replace(BASE, att_s=travel_time_s))
        for policy in policies
        for domain in ("sim", "V4")
    ]
    notes = {best_rule_note("V4"): "max-pressure:10"}
    evaluation = Evaluation("single-v1", "", tuple(results), notes)
    record = a_run(seed, name=f"s{seed}-{written:g}", evaluation=evaluation, written=written)
    return replace(record, settings={**record.settings, **settings})


def test_of_two_trainings_with_one_seed_the_newest_is_shown() -> None:
    old, new, other = judged(0, 150.0, 1.0), judged(0, 190.0, 2.0), judged(1, 200.0, 0.0)
    assert seeds_of_one([old, new, other]) == [[new, other]]
    (group,) = groups([old, new, other])
    assert group.left_out == {"s0-1": "an older training of the same seed"}
    assert {row["training_seeds"] for row in group.rows if row["setting"] != RULE} == {2}
    assert {row["att_s"] for row in group.rows} == {195.0}


def test_runs_judged_in_two_versions_of_a_real_domain_are_apart() -> None:
    worlds = ("a" * 64, "b" * 64)
    records = [
        replace(judged(seed, 100.0 + seed, 1.0), hashes={"sim": "aaa", "real": world})
        for seed, world in enumerate(worlds)
    ]
    (group,) = groups(records)
    times_s = {row["domain"]: row["att_s"] for row in group.rows if row["setting"] != RULE}
    assert times_s == {f"V4 ({'a' * 10})": 100.0, f"V4 ({'b' * 10})": 101.0}
    assert seeds_of_one(records) == [[record] for record in records]


def test_rows_that_depend_on_other_settings_are_apart() -> None:
    records = [
        judged(0, 100.0, 1.0, corrected="headway=1.4"),
        judged(1, 200.0, 1.0, corrected="acceleration=0.5", rule_budget=24),
    ]
    (group,) = groups(records)
    assert {row["setting"] for row in group.rows} == {
        "direct transfer",
        "corrected sim (corrected headway=1.4)",
        "corrected sim (corrected acceleration=0.5)",
        f"{RULE} (rule_budget as usual)",
        f"{RULE} (rule_budget 24)",
    }
    tuned = [judged(seed, 100.0, 1.0, tuning_seeds=2 + 3 * seed) for seed in range(2)]
    (other,) = groups(tuned)
    assert {row["setting"] for row in other.rows if row["setting"].startswith(RULE)} == {
        f"{RULE} (tuning_seeds 2)",
        f"{RULE} (tuning_seeds 5)",
    }
    times_s = {row["setting"]: row["att_s"] for row in group.rows if row["domain"] == "V4"}
    assert times_s["direct transfer"] == 150.0
    assert times_s["corrected sim (corrected headway=1.4)"] == 100.0


def test_jobs_that_were_not_judged_in_their_simulation_are_in_no_table() -> None:
    def judged_in(*domains: str) -> list[RunRecord]:
        results = tuple(Result("direct transfer", domain, 5, BASE) for domain in domains)
        return [
            replace(job(seed), evaluation=Evaluation("single-v1", "", results, {}))
            for seed in range(2)
        ]

    (group,) = groups(judged_in("sim", "V1", "V4"))
    assert [row["domain"] for row in group.rows] == ["V1", "V4"]
    assert groups(judged_in("V1", "V4")) == []


def test_a_seed_that_is_no_number_is_no_seed() -> None:
    times_s = {"\u00b2": 100.0, "--5": 200.0}
    records = [
        replace(one, settings={**one.settings, "seed": seed})
        for seed, time_s in times_s.items()
        for one in [judged(0, time_s, 1.0)]
    ]
    (group,) = groups(records)
    assert {row["att_s"] for row in group.rows} == {150.0}
