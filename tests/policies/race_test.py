"""Races of rules, and a rule in the place of a trained policy."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from ugat_marl.data import write_checkpoint
from ugat_marl.envs import parallel_env
from ugat_marl.errors import CheckpointError
from ugat_marl.experiments import policy_factory
from ugat_marl.policies import NamedRule, load_policy, race, race_fields, roll_out, rule_in
from ugat_marl.policies.rules.named import KIND

RULE = "largest-queue:20"


def test_the_better_half_goes_on_and_means_cover_all_rungs() -> None:
    results = {"a": [1.0, 9.0, 9.0], "b": [2.0, 2.0, 2.0], "c": [3.0, 1.0, 1.0], "d": [4.0]}
    ran: list[tuple[str, ...]] = []

    def play(rung: int, running: Sequence[str]) -> list[list[float]]:
        ran.append(tuple(running))
        return [[results[name][rung]] for name in running]

    played = race(list(results), 3, play)
    assert ran == [("a", "b", "c", "d"), ("a", "b"), ("b", "a")]
    assert played == {"b": [2.0] * 3, "a": [1.0, 9.0, 9.0], "c": [3.0], "d": [4.0]}
    assert list(played) == ["b", "a", "c", "d"]
    assert race_fields(41) == [41, 21, 11, 6, 3, 2]


def test_a_rule_is_kept_where_a_trained_policy_is(tmp_path: Path) -> None:
    file = tmp_path / "policy.pt"
    env = parallel_env("single-v1", duration_s=100, observation="movements")
    rule = NamedRule(RULE, env)
    assert rule.reads(env)
    assert not rule.reads(parallel_env("single-v1", observation="count"))
    rule.save(file)
    assert rule_in(file) == RULE
    read = policy_factory(str(file))(env)
    assert roll_out(env, read, 3) == roll_out(env, rule, 3)
    env.close()
    with pytest.raises(CheckpointError, match=f"holds the rule {RULE}, which has no network"):
        load_policy(file)


@pytest.mark.parametrize("content", ["nobody:20", "largest-queue:x", 3])
def test_a_file_with_an_impossible_rule_is_refused(content: object, tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "policy.pt", KIND, {"rule": content})
    with pytest.raises(CheckpointError, match="no rule of this version"):
        policy_factory(str(tmp_path / "policy.pt"))


def test_other_files_hold_no_rule(tmp_path: Path) -> None:
    (tmp_path / "policy.pt").write_bytes(b"PK damaged")
    assert rule_in(tmp_path / "policy.pt") is None
    assert rule_in(tmp_path / "missing.pt") is None
