"""Timed grounding in SUMO: delays by chance, delays that the models ask for, and whole runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import torch

from tests.interrupts import KillAt
from tests.runs import SMALL, checkpoint_of, numbers, play_nothing, search_few_rules
from ugat_marl.data import TransitionLog
from ugat_marl.effects import load_scenario
from ugat_marl.envs import AnyParallelEnv, TrafficEnv, parallel_env
from ugat_marl.errors import CheckpointError, OptionError, UnknownNameError
from ugat_marl.experiments import transfer
from ugat_marl.experiments.training import simulated_worlds
from ugat_marl.grounding import (
    ChangePenalty,
    GateConfig,
    GroundedEnv,
    PhaseTransform,
    RandomDelays,
    SimulatedWorld,
    StreetConfig,
    TimedConfig,
    TimedTransform,
    UgatConfig,
)
from ugat_marl.grounding.forward import ForwardConfig
from ugat_marl.grounding.residual import ResidualConfig
from ugat_marl.policies import observer_of, roll_out

MOST_S = 4


class Alternating:
    """Phase 1, phase 0, and so on, or the other way round: a green begins at every decision."""

    env_options: Mapping[str, Any] = {}

    def reset(self, seed: int) -> None:
        self._decision = seed

    def act(self, observations: Mapping[str, Any], infos: Any) -> dict[str, int]:
        self._decision += 1
        return dict.fromkeys(observations, self._decision % 2)


@pytest.fixture
def env() -> Iterator[TrafficEnv]:
    made = parallel_env("grid2x2-v1", duration_s=200)
    yield made
    made.close()


def phases_of(agents: list[str], decision: int) -> dict[str, int]:
    """Phases that some agents change, and others keep, at every decision."""
    return {agent: decision // (1 + place % 3) % 2 for place, agent in enumerate(agents)}


def play(env: AnyParallelEnv, seed: int) -> tuple[list[dict[str, float]], list[list[float]]]:
    """The delays in the infos, and the vehicles on all lanes, at every decision."""
    base: Any = env.unwrapped
    told: list[dict[str, float]] = []
    lanes: list[list[float]] = []
    env.reset(seed=seed)
    while env.agents:
        infos = env.step(phases_of(env.agents, len(told)))[4]
        told.append({agent: float(info["delay_s"]) for agent, info in infos.items()})
        lanes.append(base.snapshot.vehicles.tolist())
    return told, lanes


def replayed(env: TrafficEnv, seed: int, delays: list[dict[str, float]]) -> list[list[float]]:
    """The vehicles on all lanes where somebody asks for these delays by hand."""
    lanes: list[list[float]] = []
    env.reset(seed=seed)
    for decision, seconds in enumerate(delays):
        env.delay_greens(seconds)
        env.step(phases_of(env.agents, decision))
        lanes.append(env.snapshot.vehicles.tolist())
    return lanes


# --- delays by chance


def test_random_delays_follow_from_the_seed(env: TrafficEnv) -> None:
    delayed = RandomDelays(env, MOST_S)
    first, lanes = play(delayed, 1)
    assert (first, lanes) == play(delayed, 1)
    assert first != play(delayed, 2)[0]


def test_only_a_green_that_begins_is_said_to_be_late(env: TrafficEnv) -> None:
    delayed = RandomDelays(env, MOST_S)
    delayed.reset(seed=3)
    seen: set[float] = set()
    stayed = decision = 0
    while delayed.agents:
        before = dict(zip(env.agents, env.phases, strict=True))
        infos = delayed.step(phases_of(env.agents, decision))[4]
        for agent, info in infos.items():
            if info["executed_action"] == before[agent]:
                assert info["delay_s"] == 0.0
                stayed += 1
            seen.add(info["delay_s"])
            assert isinstance(info["delay_s"], float) and "action_mask" in info
        decision += 1
    assert stayed and seen == {0.0, 1.0, 2.0, 3.0, 4.0}


def test_what_the_infos_say_is_what_was_done(env: TrafficEnv) -> None:
    """Delays that were drawn for a green that goes on had no effect, and are not told."""
    told, lanes = play(RandomDelays(env, MOST_S), 4)
    assert lanes == replayed(env, 4, told) != replayed(env, 4, [{}] * len(told))


def test_a_change_costs_its_price_and_nothing_else_does(env: TrafficEnv) -> None:
    def paid(world: Any) -> tuple[list[float], list[bool]]:
        world.reset(seed=3)
        rewards: list[float] = []
        changes: list[bool] = []
        decision = 0
        while world.agents:
            before = dict(zip(env.agents, env.phases, strict=True))
            _, reward, _, _, infos = world.step(phases_of(env.agents, decision))
            rewards += reward.values()
            changes += [infos[a]["executed_action"] != before[a] for a in reward]
            decision += 1
        return rewards, changes

    (plain, changes), (charged, _) = paid(env), paid(ChangePenalty(env, 7.0))
    assert {True, False} == set(changes)
    assert charged == [reward - 7.0 * change for reward, change in zip(plain, changes, strict=True)]


def test_traffic_is_delayed_in_some_episodes_more_often_than_in_others(env: TrafficEnv) -> None:
    delayed = RandomDelays(env, MOST_S)
    chances = []
    for seed in range(4):
        delayed.reset(seed=seed)
        chances.append(delayed._chance)
    assert len(set(chances)) == 4 and all(0.5 <= chance <= 1.0 for chance in chances)


TIMED = UgatConfig("timed")
TIMED_RESIDUAL = UgatConfig("street", street=StreetConfig(residual=ResidualConfig("timed")))


@pytest.mark.parametrize(
    ("control", "real"),
    [
        ({"decision_interval_s": 5.0}, "V4"),
        ({"min_green_s": 8.0}, "V4"),
        ({"all_red_s": 7.0, "min_green_s": 0.0}, "V4"),
        ({}, "V4+min_green=15"),
    ],
)
@pytest.mark.parametrize("ugat", [TIMED, TIMED_RESIDUAL], ids=["timed", "residual"])
def test_greens_that_begin_later_than_asked_are_not_delayed(
    control: dict[str, float], real: str, ugat: UgatConfig
) -> None:
    """A delay would be told of one decision and executed in another, or not at all."""
    scenario = load_scenario("grid2x2-v1").with_control(**control)
    with pytest.raises(OptionError, match="in the decision that asks for it"):
        simulated_worlds(scenario, "sim", real, ugat, {})
    for undelayed in ("phase", "street"):
        simulated_worlds(scenario, "sim", real, UgatConfig(undelayed), {})
    simulated_worlds(scenario, "sim", real, replace(TIMED_RESIDUAL, grounding="phase"), {})


@pytest.mark.parametrize("reward", ["waiting", "pressure"])
def test_rewards_that_say_nothing_of_a_delay_are_not_matched(reward: str) -> None:
    matching = UgatConfig("timed", timed=TimedConfig(match=True))
    with pytest.raises(OptionError, match=f"not '{reward}'"):
        simulated_worlds(load_scenario("grid2x2-v1"), "sim", "V4", matching, {"reward": reward})
    simulated_worlds(load_scenario("grid2x2-v1"), "sim", "V4", TIMED, {"reward": reward})


@pytest.mark.parametrize("most_s", [0, MOST_S])
def test_a_world_records_its_delays_and_crossings(most_s: int) -> None:
    def make() -> TrafficEnv:
        return parallel_env("single-v1", duration_s=100, crossings=True)

    world = SimulatedWorld(make, "sim", 2, 0.3, most_s)
    log, again = (world.collect(Alternating(), 0, seed=1) for _ in range(2))
    other = world.collect(Alternating(), 1, seed=1)
    assert log is not None and again is not None and other is not None
    assert log.frame.equals(again.frame)
    rows = log.transitions("signal_0")
    assert rows.served_features.any() and log.episodes == 2
    if most_s == 0:
        assert not rows.delay_s.any()
        return
    assert not np.array_equal(rows.delay_s, other.transitions("signal_0").delay_s)
    assert set(rows.delay_s.tolist()) <= {0.0, 1.0, 2.0, 3.0, 4.0} and rows.delay_s.any()
    features = log.provenance.layouts["signal_0"].features
    phases = log.provenance.layouts["signal_0"].phases
    shown = rows.observation[:, features : features + phases].argmax(1)
    assert not rows.delay_s[shown == rows.executed].any()


# --- delays that models ask for


def timed(env: TrafficEnv, answer: str = "state", mode: str = "infinite") -> TimedTransform:
    """Untrained models declared fitted; usual delays that are no whole seconds."""
    made = TimedTransform(
        env.layouts, 3, gate=GateConfig(mode=mode, static_alpha=1e-6),
        timed=TimedConfig(most_s=MOST_S, answer=answer),
    )  # fmt: skip
    made.forward.fitted.fill_(True)
    made.inverse.fitted.fill_(True)
    places = torch.arange(made.constants.delay_s.numel(), dtype=torch.float32)
    made.constants.delay_s.copy_((places * 0.7 % MOST_S).view_as(made.constants.delay_s))
    return made


@pytest.mark.parametrize(
    ("answer", "mode"), [("state", "infinite"), ("state", "static"), ("constant", "infinite")]
)
def test_a_grounded_simulation_is_one_whose_greens_are_delayed_by_hand(
    env: TrafficEnv, answer: str, mode: str
) -> None:
    grounded = GroundedEnv(env, timed(env, answer, mode))
    _, infos = grounded.reset(seed=5)
    assert {info["delay_s"] for info in infos.values()} == {0.0}
    told, lanes = play(grounded, 5)
    values = {value for row in told for value in row.values()}
    assert 0.0 in values and len(values) > 3 and max(values) <= MOST_S
    assert lanes == replayed(env, 5, told) != replayed(env, 5, [{}] * len(told))
    if mode == "static":  # nothing of h is taken; what is usual is
        agents, usual = env.possible_agents, grounded.transform.constants.delay_s
        known = {*usual.flatten().tolist(), 0.0}
        assert values <= known
        first = [told[0][a] for a in agents]
        assert first == [0.0] * len(agents)  # phase 0 is shown from the start
        second = phases_of(agents, 1)
        changed = [i for i, a in enumerate(agents) if second[a]]
        assert changed
        for i in changed:
            assert told[1][agents[i]] == pytest.approx(float(usual[i, 1]))


def test_the_learner_is_told_of_its_own_action(env: TrafficEnv) -> None:
    grounded = GroundedEnv(env, timed(env))
    grounded.reset(seed=5)
    own = phases_of(env.agents, 1)
    infos = grounded.step(own)[4]
    for agent, info in infos.items():
        assert info["grounded_action"] == info["executed_action"] == own[agent]
        assert info["accepted"] == own[agent]  # phase 0 is shown: who keeps it has nothing to delay
        assert 0 < info["uncertainty"] <= 1


def test_a_log_recorded_in_a_grounded_simulation_says_what_was_held_back(env: TrafficEnv) -> None:
    grounded = GroundedEnv(env, timed(env, "constant"))
    log = roll_out(grounded, Alternating(), 0, record=observer_of(env)).log
    assert log is not None
    usual = grounded.transform.constants.delay_s
    for i, agent in enumerate(log.agents):
        expected = [float(usual[i, (step + 1) % 2]) for step in range(20)]
        assert log.transitions(agent).delay_s.tolist() == pytest.approx(expected)


# --- the algorithm


LATE = replace(
    SMALL,
    real="late_green=*,2",
    duration_s=150,
    ugat=replace(SMALL.ugat, grounding="timed", grounded_episodes=1, timed=TimedConfig(most_s=3)),
)


@pytest.fixture
def few_rules(monkeypatch: pytest.MonkeyPatch) -> None:
    search_few_rules(monkeypatch, "largest-queue:20")


def test_the_kind_of_grounding_decides_what_is_made(env: TrafficEnv) -> None:
    with pytest.raises(UnknownNameError, match=r"grounding 'time'\. Did you mean 'timed'"):
        UgatConfig(grounding="time")  # pyright: ignore[reportArgumentType]
    phase, timely = UgatConfig("phase"), UgatConfig("timed", timed=TimedConfig(most_s=7))
    assert UgatConfig().grounding == "street"
    assert (phase.grounding, phase.most_delay_s, timely.most_delay_s) == ("phase", 0, 7)
    assert isinstance(phase.transform(env.layouts, 0), PhaseTransform)
    made = timely.transform(env.layouts, 0)
    assert isinstance(made, TimedTransform) and made.timed.most_s == 7
    with pytest.raises(OptionError, match="include_phase"):
        replace(timely, forward=ForwardConfig(include_phase=True)).transform(env.layouts, 0)


@pytest.mark.slow
@pytest.mark.parametrize("match", [False, True])
@pytest.mark.usefixtures("few_rules")
def test_a_run_with_timed_grounding_resumes_where_it_was(match: bool, tmp_path: Path) -> None:
    timed = replace(LATE.ugat.timed, match=match)
    small = replace(LATE, ugat=replace(LATE.ugat, timed=timed))
    transfer(small, tmp_path / "unbroken")
    with pytest.raises(KeyboardInterrupt):
        transfer(small, tmp_path / "run", reporter=KillAt("fitting f and h, iteration 2"))
    other = replace(small, ugat=replace(small.ugat, grounding="phase"))
    with pytest.raises(CheckpointError, match="holds another run"):
        transfer(other, tmp_path / "run", resume=True)
    transfer(small, tmp_path / "run", resume=True)
    one, two = (pl.read_parquet(tmp_path / n / "metrics.parquet") for n in ("run", "unbroken"))
    assert one.equals(two)
    table = [(tmp_path / name / "table.json").read_text() for name in ("run", "unbroken")]
    assert table[0] == table[1]

    found = numbers(tmp_path / "run")
    for step in (1, 2):
        for name in (
            "lost_time/best_s", "lost_time/low_s/signal_0", "lost_time/high_s",
            "forward/ratio", "simulated/ratio", "inverse/guess_s", "gate/alpha",
            "att_s/late_green=*,2",
        ):  # fmt: skip
            assert (step, name) in found, name
        assert 0 <= found[step, "lost_time/low_s"] <= found[step, "lost_time/best_s"]
        assert found[step, "lost_time/best_s"] <= found[step, "lost_time/high_s"] <= 3
        for name in ("matched_s/signal_0", "beyond_s/signal_0", "chance"):
            assert ((step, f"lost_time/{name}") in found) == match
    assert found[1, "gate/alpha"] == np.inf
    assert found[2, "gate/alpha"] == pytest.approx(found[1, "gate/mean_u"])

    for name, delayed in (("sim", True), ("real", False)):
        log = TransitionLog.read(checkpoint_of(tmp_path / "run") / f"{name}-000.parquet")
        held = log.transitions("signal_0")
        assert held.delay_s.any() == delayed and held.delay_s.max() <= 3
        assert held.served_features.any()


def test_a_log_of_the_street_without_crossings_will_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    play_nothing(monkeypatch)
    street = SimulatedWorld(lambda: parallel_env("single-v1", "V4", duration_s=150), "real", 2, 0.3)
    log = street.collect(Alternating(), 0, seed=1)
    assert log is not None and not log.transitions("signal_0").served_features.size
    log.write(tmp_path / "log.parquet")
    ugat = replace(LATE.ugat, iterations=1, least_accuracy=0.2)
    config = replace(LATE, real="none", real_log=tmp_path / "log.parquet", ugat=ugat)
    transfer(config, tmp_path / "timed")
    found = numbers(tmp_path / "timed")
    assert 0 <= found[1, "lost_time/best_s"] <= 3
    assert found[1, "gate/trusted"] in (0.0, 1.0)
