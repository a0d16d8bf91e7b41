"""Each check of determinism catches an environment that breaks just its rule."""

from __future__ import annotations

import dataclasses
import itertools
import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

import ugat_marl
from ugat_marl.testing import DETERMINISM_CHECKS, ToyTraffic, check_determinism, failed_checks
from ugat_marl.testing.episodes import play, random_actions, require_same

BROKEN: list[tuple[str, type[ToyTraffic]]] = []


def breaks(check: str) -> Any:
    """Marks an environment as one that exactly `check` must catch."""

    def mark(subject: type[ToyTraffic]) -> type[ToyTraffic]:
        BROKEN.append((check, subject))
        return subject

    return mark


@breaks("a_seed_repeats_its_episode")
class FailsHalfWay(ToyTraffic):
    def step(self, actions):
        if self._step == 5:
            raise OSError("the simulator is gone")
        return super().step(actions)


@breaks("a_seed_repeats_its_episode")
class RemembersItsSeed(ToyTraffic):
    """Like libsumo on cologne1: the same start once more is not the same start."""

    last_seed: int | None = None

    def reset(self, seed=None, options=None):
        again = seed is not None and seed == self.last_seed
        self.last_seed = seed
        result = super().reset(seed)
        if again:
            self._queue["tee_0"][:] = 15
        return result


@breaks("other_episodes_leave_no_trace")
class LeavesVehicles(ToyTraffic):
    """An episode that was cut short leaves a vehicle behind."""

    def reset(self, seed=None, options=None):
        interrupted = seed is not None and getattr(self, "_step", 1) == 0
        result = super().reset(seed)
        if interrupted:
            self._queue["tee_0"][:] = 15
        return result


@breaks("replayed_actions_repeat_the_episode")
class FollowsTheOrder(ToyTraffic):
    """Draws arrivals in the order in which the actions come."""

    def step(self, actions):
        everybody = self.agents
        self.agents = list(actions)
        results = super().step(actions)
        if self.agents:
            self.agents = everybody
        return results


@breaks("replayed_actions_repeat_the_episode")
class ScoresAtRandom(ToyTraffic):
    def scores(self):
        return dataclasses.replace(super().scores(), att_s=float(next(COUNTER)))


COUNTER = itertools.count()


@breaks("live_environments_are_independent")
class SharesItsTraffic(ToyTraffic):
    """As if all simulations were one: the last one that was reset."""

    shared = np.random.default_rng()

    def reset(self, seed=None, options=None):
        result = super().reset(seed)
        SharesItsTraffic.shared = self._traffic
        return result

    def step(self, actions):
        self._traffic = SharesItsTraffic.shared
        return super().step(actions)


@breaks("other_seeds_give_other_episodes")
class IgnoresItsSeed(ToyTraffic):
    def reset(self, seed=None, options=None):
        return super().reset(7)


@breaks("resets_without_seed_follow_from_the_last")
class ForgetsItsSeed(ToyTraffic):
    def reset(self, seed=None, options=None):
        return super().reset(int(np.random.default_rng().integers(2**31)) if seed is None else seed)


@pytest.mark.parametrize(
    ("check", "subject"),
    BROKEN,
    ids=[f"{check}-{subject.__name__}" for check, subject in BROKEN],
)
def test_a_broken_environment_is_caught_by_its_check(check: str, subject: type[ToyTraffic]) -> None:
    caught = {
        result.name: result.message
        for result in check_determinism(subject)
        if result.passed is False
    }
    assert set(caught) == {check}, caught
    assert len(caught[check]) > 25


def test_every_check_has_a_broken_environment() -> None:
    assert {name for name, _ in BROKEN} == {check.__name__ for check in DETERMINISM_CHECKS}


def test_the_toy_environment_passes() -> None:
    assert not failed_checks(check_determinism(ToyTraffic))
    assert not failed_checks(check_determinism(lambda: ToyTraffic(masked=True)))


@pytest.mark.parametrize("scenario", ["single-v1", "grid2x2-v1", "mixed-v1"])
def test_the_suites_environments_pass(scenario: str) -> None:
    assert not failed_checks(
        check_determinism(lambda: ugat_marl.parallel_env(scenario, duration_s=150))
    )


def test_every_way_to_run_sumo_gives_the_same_episode() -> None:
    episodes = []
    for simulator in ("process", "spawn", "inprocess"):
        env = ugat_marl.parallel_env("mixed-v1", duration_s=100, simulator=simulator)
        episodes.append(play(env, 4, random_actions(4), 20))
        env.close()
    for other in episodes[1:]:
        require_same(episodes[0], other, "the simulators differ", "")
        assert other.scores == episodes[0].scores


def test_two_environments_in_one_process_are_caught() -> None:
    results = check_determinism(
        lambda: ugat_marl.parallel_env("single-v1", duration_s=100, simulator="inprocess")
    )
    (failed,) = failed_checks(results)
    assert failed.name == "live_environments_are_independent"
    assert 'use simulator="process"' in failed.message


EPISODE = """
import hashlib
import ugat_marl

def digest():
    env = ugat_marl.parallel_env("mixed-v1", "V2", duration_s=200, neighbours=1)
    digest = hashlib.sha256()
    observations, infos = env.reset(seed=5)
    while env.agents:
        actions = {a: i % int(env.action_space(a).n) for i, a in enumerate(env.agents)}
        observations, rewards, *_ = env.step(actions)
        digest.update(b"".join(observations[a].tobytes() for a in sorted(observations)))
        digest.update(repr(sorted(rewards.items())).encode())
    digest.update(repr(env.scores()).encode())
    env.close()
    return digest.hexdigest()
"""


def test_every_process_sees_the_same_episode() -> None:
    """String hashes differ from process to process, and with them the order of sets."""
    other = subprocess.run(
        [sys.executable, "-c", EPISODE + "print(digest())"],
        env={**os.environ, "PYTHONHASHSEED": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    here: dict[str, Any] = {}
    exec(EPISODE, here)
    assert other.stdout.strip() == here["digest"]()
