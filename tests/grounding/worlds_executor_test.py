"""Roll-outs of a world on an executor: what one environment plays one after the other."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from ugat_marl.envs import TrafficEnv, parallel_env
from ugat_marl.experiments import TransferConfig, transfer
from ugat_marl.grounding import SimulatedWorld
from ugat_marl.policies import DQN, DQNConfig, RollOutStopped, make_rule

MAKE = partial(parallel_env, "single-v1", "V4", duration_s=120, observation="movements")


@pytest.mark.parametrize("most_delay_s", [0, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("rule", [None, "largest-queue:20"])  # which remembers its episode
def test_an_executor_plays_the_same(most_delay_s: int, rule: str | None) -> None:
    env = MAKE()
    policy = DQN.of(env, DQNConfig(), 3).policy() if rule is None else make_rule(rule, env)
    env.close()
    here = SimulatedWorld(MAKE, "real", 3, 0.3, most_delay_s)
    with ThreadPoolExecutor(2) as pool:
        there = SimulatedWorld(MAKE, "real", 3, 0.3, most_delay_s, pool)
        for iteration in (0, 1):
            one, other = (world.collect(policy, iteration, 7) for world in (here, there))
            assert one is not None and other is not None
            assert one.frame.equals(other.frame)
        done: list[None] = []
        found = [w.under_delays(policy, 0, 7, lambda: done.append(None)) for w in (here, there)]
        assert len(done) == 2 * here.roll_outs_under_delays == 4 * (most_delay_s + 1)
        logs = list(zip(*found, strict=True))
        assert [one.frame.equals(other.frame) for one, other in logs] == [True] * (most_delay_s + 1)


def test_it_can_be_stopped() -> None:
    """A stop ends what runs; one that comes too late does not end the next roll-out."""
    rule, stops = make_rule("fixed-time", MAKE()), [True]

    def make(**options: Any) -> TrafficEnv:
        if stops:
            world.stop()
        return MAKE(**options)

    with ThreadPoolExecutor(1) as pool:
        world = SimulatedWorld(make, "real", 2, 0.0, workers=pool)
        with pytest.raises(RollOutStopped, match="another roll-out failed"):
            world.collect(rule, 0, 7)
        stops.clear()
        world.stop()
        assert world.collect(rule, 0, 7) is not None


def test_a_run_plays_its_roll_outs_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[SimulatedWorld] = []

    def refused(*given: Any, **_: Any) -> Any:
        asked.extend(given[3])  # the sources of D_sim and D_real
        raise RollOutStopped

    monkeypatch.setattr("ugat_marl.experiments.jobs.train_grounded", refused)
    config = TransferConfig("single-v1", duration_s=60)
    with ThreadPoolExecutor(1) as pool, pytest.raises(RollOutStopped):
        transfer(config, tmp_path, workers=pool)
    assert [world._workers for world in asked] == [pool, pool]
