"""The preset "paper": Algorithm 1 as published, and nothing else beside it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from ugat_marl.errors import OptionError
from ugat_marl.experiments import TransferConfig
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
