"""Rivals of a fitted street: greens are as late as the street's, and a stop changes nothing."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.interrupts import KillAt
from tests.runs import FITTED, SMALL, checkpoint_of, numbers, play_nothing, weights
from ugat_marl.data import TransitionLog
from ugat_marl.effects import late_greens, load_scenario
from ugat_marl.envs import parallel_env
from ugat_marl.errors import UnknownNameError
from ugat_marl.experiments import transfer
from ugat_marl.grounding import (
    DIRECT_LEARNER,
    JUDGED,
    RIVALS,
    Simulation,
    StreetConfig,
    StreetTraining,
)
from ugat_marl.grounding.rival import LONGEST_S, ROLL_OUTS, Rival, late_world, matched_delays
from ugat_marl.grounding.street import StreetWorld
from ugat_marl.grounding.worlds import EPISODES_PER_DELAY
from ugat_marl.parallel import Stop
from ugat_marl.policies import DQNConfig, EpsilonGreedy, make_rule, observer_of, roll_out

QUICK = StreetConfig(
    simulations=20, further=4, simulated_s=100.0, judged=1, rule_budget=0, rival="matched"
)
CONFIG = replace(
    SMALL, ugat=replace(FITTED, street=QUICK, iterations=1)
)  # fmt: skip
LATE_S = 2.5


def rivals_win(patch: pytest.MonkeyPatch) -> None:
    """Let rewards ask for late greens, and the last rival win each comparison without rules."""
    compare = Simulation.compare

    def matched(real: TransitionLog, *_: object) -> dict[str, float]:
        return dict.fromkeys(real.provenance.layouts, LATE_S)

    def compared(
        self: Simulation, worlds: Any, policies: Any, seeds: Any, on_done: Any
    ) -> NDArray[np.float64]:
        times_s = compare(self, worlds, policies, seeds, on_done)
        times_s[-1] = times_s.min() - 1.0  # the policies end with those of rivals
        return times_s

    patch.setattr("ugat_marl.grounding.street_training.matched_delays", matched)
    patch.setattr(Simulation, "compare", compared)


@pytest.mark.parametrize(
    ("domain", "least_s", "most_s"), [("late_green=*,3", 1.5, 4), ("sim", 0, 1)]
)
def test_greens_are_as_late_as_those_of_the_street(
    domain: str, least_s: float, most_s: float
) -> None:
    scenario = load_scenario("single-v1")
    options: dict[str, Any] = {"duration_s": 900.0, "observation": "movements"}
    with contextlib.closing(parallel_env(scenario, domain, **options)) as env:
        rule = EpsilonGreedy(make_rule("max-pressure:10", env), 0.3)
        logs = [roll_out(env, rule, seed, record=observer_of(env)).log for seed in (1, 2, 3)]
        street = TransitionLog.concatenate([log for log in logs if log is not None])
        simulation = Simulation(scenario, options, epsilon=0.3, workers=1)
        done: list[None] = []
        acting = make_rule("max-pressure:10", env)
    found = matched_delays(street, simulation, acting, 0, lambda: done.append(None))
    assert list(found) == ["signal_0"]
    assert least_s <= found["signal_0"] <= most_s
    assert len(done) == ROLL_OUTS


def test_each_light_is_late_by_its_own_delay() -> None:
    world = late_world({"a": 2.5, "b": 0.0, "c": 1.0}, {"a": "A", "b": "B", "c": "C"})
    late = ["late_green=A,2.5", "late_green=B,0", "late_green=C,1"]
    assert [str(effect) for effect in world.effects] == late


@pytest.mark.parametrize("own_s", [0, 2])
def test_delays_do_not_depend_on_late_greens_of_the_simulation(
    own_s: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    with contextlib.closing(parallel_env("single-v1", f"late_green=*,{own_s}")) as env:
        simulation = Simulation(env.scenario, {"duration_s": 100.0}, epsilon=0.0, workers=1)
        rule = make_rule("max-pressure:10", env)
    logs, late_s = Simulation.logs, list[float]()

    def seen(self: Simulation, worlds: Any, *others: Any) -> list[TransitionLog]:
        for world in worlds:
            with contextlib.closing(self.env(world)) as env:
                late_s.append(max(late_greens(env.scenario).values(), default=0.0))
        return logs(self, worlds, *others)

    monkeypatch.setattr(Simulation, "logs", seen)
    street = simulation.play(StreetWorld(), rule, 1, Stop())
    matched_delays(street, simulation, rule, 0, lambda: None)
    assert late_s == [float(s) for s in range(LONGEST_S + 1) for _ in range(EPISODES_PER_DELAY)]


def test_greens_that_are_0_s_late_change_no_number() -> None:
    simulation = Simulation(load_scenario("grid2x2-v1"), {"duration_s": 300.0}, 0.3, workers=1)
    with contextlib.closing(simulation.plain(0)) as env:
        rule, lights = make_rule("max-pressure:10", env), env.intersection_of
    in_time = late_world(dict.fromkeys(lights, 0.0), lights)
    one, other = (simulation.play(world, rule, 1, Stop()) for world in (StreetWorld(), in_time))
    assert one.frame.equals(other.frame)


@pytest.mark.slow
@pytest.mark.parametrize(("rival", "late_s"), [("matched", LATE_S), ("several", 5.0)])
def test_a_rival_is_direct_transfer_trained_further_with_late_greens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rival: Any, late_s: float
) -> None:
    street = replace(QUICK, rival=rival)
    config = replace(CONFIG, ugat=replace(CONFIG.ugat, street=street))
    play_nothing(monkeypatch)
    rivals_win(monkeypatch)
    trainings: list[StreetTraining] = []
    train = StreetTraining.train

    def seen(self: StreetTraining, state: Any) -> Any:
        trainings.append(self)
        return train(self, state)

    monkeypatch.setattr(StreetTraining, "train", seen)
    transfer(config, tmp_path, workers=1)
    (direct,) = tmp_path.glob(f"trainings/*/{DIRECT_LEARNER}")
    with contextlib.closing(
        parallel_env(
            load_scenario("single-v1"), f"late_green=*,{late_s}", duration_s=CONFIG.duration_s
        )
    ) as env:
        learner = trainings[0].make(env, CONFIG.seed)
        learner.load(direct)
        learner.learn(env, CONFIG.ugat.grounded_episodes, CONFIG.seed)
        policy: Any = learner.policy()
    assert np.array_equal(weights(tmp_path, "fitted-street"), policy.parameters)
    logged = numbers(tmp_path)
    best = "of_the_rival" if rival == "matched" else "of_the_rival_5_s_late"
    times_s = {name: value for (_, name), value in logged.items() if name.startswith("judged/")}
    assert min(times_s, key=lambda name: times_s[name]) == f"judged/{best}"
    assert len(times_s) == 2 + len(street.late_s)  # direct transfer and the policy of the street
    assert logged[1, "rival/late_s/signal_0"] == LATE_S


@pytest.mark.slow
def test_an_interrupted_rival_ends_as_an_unbroken_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    play_nothing(monkeypatch)
    rivals_win(monkeypatch)
    street = replace(QUICK, rival="several")
    config = replace(CONFIG, ugat=replace(CONFIG.ugat, iterations=2, street=street))
    transfer(config, tmp_path / "whole", workers=1)
    for task in ("late greens of 3 s, iteration 1", "comparing, iteration 2"):
        with pytest.raises(KeyboardInterrupt):
            transfer(config, tmp_path / "broken", resume=True, reporter=KillAt(task), workers=1)
    files = {path.name for path in checkpoint_of(tmp_path / "broken").glob("rival*.pt")}
    assert files == {"rival.pt", "rival-3-s-late.pt", "rival-5-s-late.pt"}
    transfer(config, tmp_path / "broken", resume=True, workers=1)
    one, other = (weights(tmp_path / run, "fitted-street") for run in ("whole", "broken"))
    assert np.array_equal(one, other)
    assert numbers(tmp_path / "whole") == numbers(tmp_path / "broken")


@pytest.mark.slow
def test_late_commands_leave_no_rival(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also with the learner that always sees its commands, and does not begin anew."""
    play_nothing(monkeypatch)
    config = replace(CONFIG, learner="universal", dqn=DQNConfig(teacher=None))
    transfer(replace(config, real="execution_delay=20+lost_commands=0.2"), tmp_path, workers=1)
    logged = numbers(tmp_path)
    assert logged[1, "street/commands"] > 0
    assert not [name for _, name in logged if "rival" in name]


@pytest.mark.parametrize(
    ("street", "late_s"),
    [
        (QUICK, (None,)),
        (replace(QUICK, rival="several"), (None, 3.0, 5.0)),
        (replace(QUICK, rival="none"), ()),
        (replace(QUICK, judged=0), ()),
    ],
)
def test_only_a_street_in_which_policies_are_compared_has_rivals(
    street: StreetConfig, late_s: tuple[float | None, ...]
) -> None:
    assert street.late_s == late_s


def test_every_rival_has_words_for_the_comparison() -> None:
    learner: Any = None
    every = {late_s for several in RIVALS.values() for late_s in several}
    names = {Rival(learner, Path(), late_s).judged for late_s in every}
    assert names == {name for name in JUDGED if "rival" in name}


def test_an_unknown_rival_is_refused() -> None:
    other: Any = "phase"
    with pytest.raises(UnknownNameError, match="rival"):
        StreetConfig(rival=other)
