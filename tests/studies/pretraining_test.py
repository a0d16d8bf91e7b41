"""Pretraining on several road networks: memories, shared weights, and the start that they give."""

from __future__ import annotations

from dataclasses import replace

import torch

from studies.pretraining import OPTIONS, SETTINGS, Pretraining
from ugat_marl.envs import parallel_env
from ugat_marl.policies import DQN

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
    assert torch.equal(elsewhere.running_weights, start.weights)
    for env in envs.values():
        env.close()
