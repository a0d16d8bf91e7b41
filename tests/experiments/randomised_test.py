"""Domain randomisation: what is drawn, that a seed decides it, and that nothing is left behind."""

from __future__ import annotations

import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.interrupts import eventually
from ugat_marl.effects import PAPER_WORLDS, load_scenario, scenario_in_domain
from ugat_marl.envs import parallel_env
from ugat_marl.errors import ScenarioError
from ugat_marl.experiments.randomised import (
    RandomisedEnv,
    drawn_effects,
    effect_ranges,
    randomised_env,
)
from ugat_marl.testing import ToyTraffic

SINGLE = load_scenario("single-v1")
SHORT = {"duration_s": 100}
VALUE = {"startup_delay": "seconds"}


def value(effect: Any) -> float:
    return getattr(effect, VALUE.get(effect.name, "mps2"))


def test_the_ranges_are_the_hull_of_the_worlds_the_simulation_and_the_library() -> None:
    found = {item.name: (item.low, item.high) for item in effect_ranges(SINGLE)}
    assert found == {
        "acceleration": (0.5, 2.6),  # V4 and sim
        "deceleration": (1.5, 4.5),  # V4 and sim
        "emergency_deceleration": (2.0, 9.0),  # V4 and sim
        "startup_delay": (0.0, 1.2),  # sim and the strongest a diagnosis reckons with
    }
    for effects in PAPER_WORLDS.values():
        for effect in effects:
            low, high = found[effect.name]
            assert low <= value(effect) <= high


def test_the_ranges_hold_the_simulations_own_value() -> None:
    brisk = scenario_in_domain(SINGLE, "acceleration=4.0")
    found = {item.name: item.high for item in effect_ranges(brisk)}
    assert found["acceleration"] == 4.0


def test_draws_fill_the_ranges_and_follow_the_seed() -> None:
    ranges = effect_ranges(SINGLE)
    draws = [drawn_effects(ranges, seed) for seed in range(300)]
    assert draws[7] == drawn_effects(ranges, 7)
    assert len({str(draw) for draw in draws}) == 300
    by_name = {
        item.name: np.array([value(e) for draw in draws for e in draw if e.name == item.name])
        for item in ranges
    }
    for item in ranges:
        values, width = by_name[item.name], item.high - item.low
        assert len(values) == 300
        assert values.min() >= item.low and values.max() <= item.high
        assert values.max() > item.high - 0.05 * width
        if item.name != "emergency_deceleration":  # drawn up to the usual deceleration
            assert values.min() < item.low + 0.05 * width
            assert values.mean() == pytest.approx(item.low + width / 2, abs=0.08 * width)
    assert (by_name["emergency_deceleration"] >= by_name["deceleration"]).all()
    one, two = by_name["acceleration"], by_name["startup_delay"]
    assert abs(np.corrcoef(one, two)[0, 1]) < 0.15  # each is drawn for itself


def episode(env: Any, seed: int | None) -> list[Any]:
    """Everything an agent hears in an episode under a fixed schedule."""
    heard: list[Any] = []
    observations, _ = env.reset(seed=seed)
    step = 0
    while env.agents:
        heard.append({agent: seen.tolist() for agent, seen in observations.items()})
        actions = {agent: step // 3 % env.action_space(agent).n for agent in env.agents}
        observations, rewards, *_ = env.step(actions)
        heard.append(rewards)
        step += 1
    return heard


def test_the_seed_decides_world_and_episode_to_the_bit() -> None:
    env = randomised_env(SINGLE, SHORT)
    first, hash_1 = episode(env, 1), env.scenario.hash
    other, hash_2 = episode(env, 2), env.scenario.hash
    again = episode(env, 1)
    assert first == again and env.scenario.hash == hash_1
    assert first != other and hash_1 != hash_2
    plain = parallel_env(SINGLE, drawn_effects(effect_ranges(SINGLE), 1), **SHORT)
    assert plain.scenario.hash == hash_1
    assert episode(plain, 1) == first  # it is that world, and not merely called so
    unseeded = [episode(env, None) for _ in range(2)]
    assert unseeded[0] != unseeded[1]
    episode(env, 1)
    assert [episode(env, None) for _ in range(2)] == unseeded
    env.close()
    plain.close()


def descendants() -> set[str]:
    text = subprocess.run(["ps", "-eo", "pid,ppid"], capture_output=True, text=True, check=True)
    pairs = [line.split() for line in text.stdout.splitlines()[1:]]
    found = {str(os.getpid())}
    while more := {pid for pid, parent in pairs if parent in found} - found:
        found |= more
    return found


def test_no_process_and_no_folder_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    before = len(descendants())
    env = randomised_env(SINGLE, SHORT)
    at_work: list[int] = []
    for seed in range(4):
        env.reset(seed=seed)
        env.step(dict.fromkeys(env.agents, 0))  # the next reset ends it half way
        at_work.append(len(descendants()))
    assert len(set(at_work)) == 1 and at_work[0] > before
    env.close()
    # a process that was told to end takes a moment on a busy machine
    assert eventually(lambda: len(descendants()) == before, 20.0)
    assert not list(tmp_path.iterdir())


def test_a_world_with_other_agents_is_refused() -> None:
    made: list[str] = []

    def make(effects: Any) -> Any:
        made.append(str(effects))
        return parallel_env("single-v1", effects, **SHORT) if len(made) == 1 else ToyTraffic()

    env = RandomisedEnv(make, effect_ranges(SINGLE))
    with pytest.raises(ScenarioError, match="other agents, observations or phases"):
        env.reset(seed=0)
    assert made[0] == "()" and made[1].count("=") >= 4  # spaces are those of the simulation
