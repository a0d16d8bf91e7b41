"""From nothing to a training step on a grid of 64 intersections."""

from __future__ import annotations

from pathlib import Path

import pytest

from ugat_marl.__main__ import main
from ugat_marl.envs import parallel_env
from ugat_marl.policies import DQN, DQNConfig


@pytest.mark.nightly
def test_a_grid_of_64_is_made_checked_and_trained_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "grid"
    assert main(["scenario", "new", str(target), "--grid", "8x8", "--vph", "250"]) == 0
    assert main(["scenario", "check", str(target)]) == 0
    env = parallel_env(target, duration_s=300)
    learner = DQN.of(env, DQNConfig(warmup_decisions=10), 0)
    learner.learn(env, 1, 0)
    env.close()
    assert "nothing to fix" in capsys.readouterr().out
    assert learner.updates == 21  # at each of the 30 decisions from the tenth on
