"""Training of a baseline's file: what it writes."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from ugat_marl.envs import parallel_env
from ugat_marl.experiments import BaselineArgs, train_baseline
from ugat_marl.policies import make_rule


@pytest.mark.filterwarnings("ignore:.*no vehicle has entered")
def test_the_travel_time_of_nobody_is_null(
    crossing: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nobody = '<flow id="f" type="car" route="north" begin="0" end="20" probability="1e-9"/>'
    scenario, out = str(crossing(vehicles=nobody)), tmp_path / "out"

    class Learner:
        def policy(self) -> Any:
            return self

        def save(self, path: Path) -> None:
            path.touch()

    def train_through(*_: Any, **__: Any) -> Iterator[tuple[int, Any]]:
        yield 1, make_rule("fixed-time:20", parallel_env(scenario))

    monkeypatch.setattr("ugat_marl.experiments.baseline.train_through", train_through)
    out.mkdir()
    args = BaselineArgs(scenario, duration_s=20, episodes=1, evaluation_seeds=1, out=out)
    train_baseline(args, lambda _: Learner())
    assert json.loads((out / "result.json").read_text())["att_s"] == {"1": [None]}
