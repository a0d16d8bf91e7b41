"""Pretraining on several road networks: memories, shared weights, and the start that they give."""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from studies import pretraining as study
from studies.pretraining import OPTIONS, SETTINGS, Pretraining, play
from ugat_marl.envs import parallel_env
from ugat_marl.policies import DQN
from ugat_marl.seeding import derive_seed

OBSERVED = {**OPTIONS, "duration_s": 200.0}
DECISIONS = 20


def test_it_learns_on_several_networks_and_keeps_a_memory_of_each() -> None:
    envs = {name: parallel_env(name, **OBSERVED) for name in ("single-v1", "arterial1x5-v1")}
    pretraining = Pretraining(replace(SETTINGS, warmup_decisions=5, batch_size=20), seed=0)
    pretraining.play(envs, updates=12, epsilon=0.5)
    pretraining.play({"single-v1": envs["single-v1"]}, updates=6, epsilon=0.5)
    assert {name: x.decisions for name, x in pretraining.learners.items()} == {
        "single-v1": 2 * DECISIONS, "arterial1x5-v1": DECISIONS,
    }  # fmt: skip
    assert sum(learner.updates for learner in pretraining.learners.values()) == 18
    # a batch holds as many transitions of one agent as of five together
    sizes = {name: x.config.batch_size for name, x in pretraining.learners.items()}
    assert sizes == {"single-v1": 20, "arterial1x5-v1": 4}
    start = pretraining.start("a test")
    assert start.env_options["commands"] == OBSERVED["commands"]
    elsewhere = DQN.of(parallel_env("mixed-v1", **OBSERVED), SETTINGS)
    elsewhere.load_initial_weights(start)
    assert np.array_equal(elsewhere.policy().parameters, start.weights)
    for env in envs.values():
        env.close()


@pytest.mark.parametrize("count", [1, 3, 5])
def test_every_drawn_episode_is_played_once_on_few_networks(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[int] = []
    played: Counter[str] = Counter()

    def drawn_domain(_: object, seed: int) -> str:
        drawn.append(seed)
        return "sim"

    def play_them(envs: dict[str, Any], updates: int, epsilon: float) -> None:
        played.update(envs.keys())
        training.episodes += len(envs)

    training: Any = SimpleNamespace(episodes=0, play=play_them, set_learning_rate=lambda rate: None)
    networks: list[Any] = [SimpleNamespace(id=f"d{k}") for k in range(count)]
    monkeypatch.setattr(study, "drawn_domain", drawn_domain)
    monkeypatch.setattr(study, "parallel_env", lambda *_, **__: SimpleNamespace(close=list))
    given = argparse.Namespace(seed=0, episodes=60, updates=1)
    while training.episodes < given.episodes:
        play(training, networks, given)
    assert drawn == [derive_seed(0, "domain", episode) for episode in range(len(drawn))]
    assert training.episodes == len(drawn) == played.total()
    assert max(played.values()) - min(played.values()) <= 1
