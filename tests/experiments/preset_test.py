"""The preset "paper": Algorithm 1 as published, and nothing else beside it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from ugat_marl.errors import OptionError
from ugat_marl.experiments import PaperConfig, TransferConfig
from ugat_marl.experiments.paper import settings_of
from ugat_marl.grounding import GateConfig, UgatConfig, as_published


def test_the_preset_restores_every_departure_and_keeps_numbers_of_episodes() -> None:
    config = TransferConfig("single-v1", preset="paper", ugat=UgatConfig(grounded_episodes=7))
    ugat = config.ugat
    assert ugat.grounding == "phase"
    assert ugat.grounded_episodes == ugat.gate.window_epochs == 7
    assert (ugat.rollout_epsilon, ugat.least_accuracy) == (0.0, None)
    assert ugat.forward.include_phase and ugat.inverse.include_phase
    assert (ugat.fit.kl_weight, ugat.fit.off_data_weight, ugat.fit.epochs) == (1.0, 0.0, 300)
    assert ugat.gate.scope == "pooled"
    assert replace(config, seed=3).ugat == ugat  # applied twice it changes nothing
    assert as_published(ugat) == ugat


def test_what_the_preset_decides_cannot_be_given_beside_it() -> None:
    with pytest.raises(OptionError, match="decides all settings"):
        TransferConfig("single-v1", preset="paper", ugat=UgatConfig(grounding="timed"))
    with pytest.raises(OptionError, match="decides all settings"):
        TransferConfig(
            "single-v1", preset="paper", ugat=UgatConfig(gate=GateConfig(mode="infinite"))
        )


def test_the_preset_is_paid_by_the_queue_at_the_light() -> None:
    assert TransferConfig("single-v1").reward == "total-queue"
    assert TransferConfig("single-v1", preset="paper").reward == "queue"
    assert TransferConfig("single-v1", preset="paper", reward="queue").reward == "queue"
    with pytest.raises(OptionError, match="not 'pressure'"):
        TransferConfig("single-v1", preset="paper", reward="pressure")


def test_the_tables_have_the_preset_too() -> None:
    config = PaperConfig(preset="paper", episodes=7, grounded_episodes=4)
    same = TransferConfig(
        "single-v1",
        preset="paper",
        ugat=UgatConfig(
            pretrain_episodes=7,
            iterations=config.iterations,
            grounded_episodes=4,
            sim_rollouts=config.sim_rollouts,
            real_rollouts=config.real_rollouts,
        ),
    )
    assert (config.ugat, config.reward, config.learner) == (same.ugat, "queue", same.learner)
    assert config.episodes == config.ugat.pretrain_episodes == 7
    assert config.all_episodes == 7 + 4 * config.ugat.iterations
    rows = settings_of("main", config.ugat, "sim", config.groundings, learner=config.spec)
    assert [row.ugat for row in rows if row.ugat is not None] == [config.ugat]
    assert replace(config, seeds=2).ugat == config.ugat  # applied twice it changes nothing
    for wrong in (
        {"groundings": ("timed",)},
        {"reward": "pressure"},
        {"gate": GateConfig("static")},
    ):
        with pytest.raises(OptionError, match="preset"):
            PaperConfig(preset="paper", **wrong)
