"""Delays with which a simulation pays what a street pays: by hand, and planted in SUMO."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from sklearn.isotonic import IsotonicRegression

from ugat_marl.data import AgentLayout, Provenance, TransitionLog, TransitionRecorder
from ugat_marl.envs import parallel_env
from ugat_marl.errors import CheckpointError
from ugat_marl.experiments import student_p
from ugat_marl.grounding import SimulatedWorld, TimedConfig, TimedTransform, UgatConfig
from ugat_marl.grounding.delays import (
    CHANCE,
    EpisodeRewards,
    ModelErrors,
    _between,
    chance_of,
    episode_rewards,
    falling,
    match_delays,
    matching_delays,
)
from ugat_marl.grounding.reports import Floats
from ugat_marl.policies import make_rule

LAYOUTS = {"b_0": AgentLayout(2, 2), "a_0": AgentLayout(2, 2)}
SIGHT: dict[str, Any] = {"duration_s": 3600, "observation": "movements"}


def test_a_curve_that_rises_by_chance_is_averaged_there() -> None:
    assert falling(np.array([3.0, 1.0, 2.0, 0.0])).tolist() == [3.0, 1.5, 1.5, 0.0]
    assert falling(np.array([1.0, 2.0, 3.0])).tolist() == [2.0, 2.0, 2.0]
    assert falling(np.array([2.0, 3.0, 1.0, 2.0, 3.0])).tolist() == [2.5, 2.5, 2.0, 2.0, 2.0]


@given(st.lists(st.integers(-50, 50), min_size=1, max_size=8), st.data())
def test_no_other_falling_curve_is_closer(values: list[int], data: st.DataObject) -> None:
    own = np.array(values, dtype=np.float64)
    found = falling(own)
    drawn = data.draw(st.lists(st.integers(-50, 50), min_size=len(own), max_size=len(own)))
    other = np.array(sorted(drawn, reverse=True), dtype=np.float64)
    assert (np.diff(found) <= 1e-9).all() and found.sum() == pytest.approx(own.sum())
    assert ((found - own) ** 2).sum() <= ((other - own) ** 2).sum() + 1e-9


@given(st.lists(st.floats(-50, 0), min_size=1, max_size=8))
def test_the_falling_curve_is_that_of_scikit_learn(values: list[float]) -> None:
    theirs = IsotonicRegression(increasing=False).fit_transform(np.arange(len(values)), values)
    assert falling(np.array(values)) == pytest.approx(theirs, abs=1e-9)


def test_delays_lie_where_the_rewards_are_the_same() -> None:
    one = np.array([-10.0, -12.0, -20.0, -30.0])
    level = np.array([-10.0, -10.0, -20.0, -20.0])  # of delays that pay the same the shortest
    streets = [-9.0, -10.0, -11.0, -16.0, -30.0, -99.0]
    expected = [0.0, 0.0, 0.5, 1.5, 3.0, 3.0]
    curves = np.repeat(one[:, None], len(streets), axis=1)
    assert matching_delays(np.array(streets), curves) == pytest.approx(expected)
    curves = np.repeat(level[:, None], 4, axis=1)
    paid = np.array([-10.0, -15.0, -20.0, -25.0])
    assert matching_delays(paid, curves).tolist() == [0.0, 1.5, 2.0, 2.0]


@given(st.lists(st.integers(-50, 50), min_size=1, max_size=8), st.integers(-60, 60))
def test_the_curve_pays_at_the_delay_what_the_street_pays(values: list[int], paid: int) -> None:
    own = np.array(values, dtype=np.float64)
    (delay,) = matching_delays(np.array([float(paid)]), own[:, None])
    curve = falling(own)
    pays = np.interp(delay, np.arange(len(own)), curve)
    assert pays == pytest.approx(min(max(paid, curve[-1]), curve[0]), abs=1e-9)
    earlier = np.linspace(0.0, delay, 50)[:-1]
    assert (np.interp(earlier, np.arange(len(own)), curve) >= pays - 1e-9).all()


def test_rewards_are_means_of_episodes_in_the_order_that_is_asked_for() -> None:
    recorder = TransitionRecorder(Provenance("street", "", "sim", (), 10.0, "count", LAYOUTS))
    seen = {agent: np.zeros(4) for agent in LAYOUTS}
    did, late = dict.fromkeys(LAYOUTS, 0), dict.fromkeys(LAYOUTS, 0.0)
    for place, rewards in (((0, 0), (1.0, 5.0)), ((0, 1), (2.0, 5.0)), ((1, 0), (6.0, 8.0))):
        paid = dict(zip(LAYOUTS, rewards, strict=True))
        recorder.record(*place, seen, did, did, paid, seen, late)
    log = recorder.log()
    assert episode_rewards(log, ["a_0", "b_0"]).tolist() == [[5.0, 1.5], [8.0, 6.0]]
    assert episode_rewards(log, ["b_0", "a_0"]).tolist() == [[1.5, 5.0], [6.0, 8.0]]
    silent = (pl.col("agent") == "b_0") & (pl.col("episode") == 1)
    log = TransitionLog(log.provenance, log.frame.filter(~silent))
    assert episode_rewards(log, ["b_0", "a_0"]).tolist() == [[1.5, 5.0], [1.5, 8.0]]


def test_rows_at_a_delay_lie_between_those_of_whole_seconds() -> None:
    rows = torch.tensor([[1.0, 3.0, 7.0]])
    found = [_between(rows, seconds).item() for seconds in (0.0, 0.25, 1.5, 2.0)]
    assert found == pytest.approx([1.0, 1.5, 5.0, 7.0])


def test_errors_of_a_model_are_those_of_the_rows_with_weight() -> None:
    """It predicts no change; the second agent has two rows, and two of padding."""
    change = torch.tensor([[1.0, -1.0, 3.0, 3.0], [2.0, -2.0, 9.0, 9.0]])[..., None]
    delay_s = torch.tensor([[0.0, 1.2, 1.0, 5.0], [2.0, 0.4, 0.0, 0.0]])
    executed = torch.tensor([[0, 0, 1, 1], [1, 0, 0, 0]])
    weight = torch.tensor([[1.0, 1.0, 1.0, 1.0], [1.0, 1.0, 0.0, 0.0]])
    data: Any = SimpleNamespace(
        observation=None, outcome=change, delay_s=delay_s, executed=executed, weight=weight
    )

    class Nothing:
        stack, view = SimpleNamespace(actions=2), SimpleNamespace(of=lambda data: None)
        most_s, scale = 2, 1.0

        def change(self, observation: None, outcome: torch.Tensor) -> torch.Tensor:
            return outcome

        def extra(self, delay_s: torch.Tensor) -> torch.Tensor:
            return delay_s

        def __call__(self, seen: None, executed: Any, extra: torch.Tensor) -> torch.Tensor:
            return torch.zeros(*extra.shape, 1)

    model: Any = Nothing()
    errors = ModelErrors.of(model, data)
    assert errors.spread.flatten().tolist() == pytest.approx([math.sqrt(5.0), 2.0])
    by_second = [[[1.0, 1.0, 0.0], [0.0, 1.0, 1.0]], [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]]
    assert errors.rows.tolist() == by_second


def twice(curve: Floats) -> Floats:
    """A curve from two equal episodes of one intersection, ``(delays, 2, 1)``."""
    return np.repeat(curve, 2).reshape(-1, 2, 1)


def test_chance_is_that_of_students_t() -> None:
    street = np.array([[-9.0], [-11.0]])
    simulated = twice(np.array([-10.0, -12.0, -14.0, -17.0, -20.0]))
    simulated[2] *= np.array([[0.9], [1.1]])
    before = [np.array([[-18.0], [-22.0]]), np.array([[-5.0]])]
    # Three pairs are 1 in 10 off their mean, the other delays' four are not.
    varies, degrees = math.sqrt(6 * 0.1**2 / 7), 7
    for expected, delay_s in ((10.0, 0.0), (12.0, 1.0), (13.0, 1.5), (20.0, 4.0)):
        t = (expected - 10.0) / (varies * math.sqrt(10.0**2 / 2 + expected**2 / 2))
        found = chance_of(EpisodeRewards(street, simulated, before), np.array([delay_s]))
        assert found == pytest.approx(student_p(t, degrees))


def test_one_episode_of_each_says_nothing_of_chance() -> None:
    assert (
        chance_of(
            EpisodeRewards(np.array([[-50.0]]), np.array([[[-10.0]], [[-60.0]]])), np.zeros(1)
        )
        == 1
    )


def test_rewards_that_never_vary_leave_nothing_to_chance() -> None:
    paid = EpisodeRewards(np.array([[-10.0], [-10.0]]), twice(np.array([-10.0, -12.0])))
    assert chance_of(paid, np.zeros(1)) == 1.0
    assert chance_of(paid, np.ones(1)) == 0.0
    assert chance_of(EpisodeRewards(np.zeros((2, 1)), twice(np.zeros(2))), np.zeros(1)) == 1.0


CURVE = -10.0 * np.array([1.0, 1.15, 1.35, 1.6, 2.0, 2.6])


def hours(rng: np.random.Generator, mean: Floats | float, agents: int) -> Floats:
    """Two hours for each mean; their traffic, 8 % more or less, all intersections share."""
    means = np.asarray(mean)[..., None, None] * np.ones((2, agents))
    shared = 1.0 + 0.08 * rng.standard_normal((*means.shape[:-1], 1))
    return means * shared * (1.0 + 0.05 * rng.standard_normal(means.shape))


@pytest.mark.parametrize("agents", [1, 16])
def test_chance_is_seldom_taken_for_a_delay_and_a_delay_seldom_for_chance(agents: int) -> None:
    rng = np.random.default_rng(0)
    found: dict[float, list[bool]] = {0.0: [], 1.0: [], 4.0: []}
    for late, taken in found.items():
        street = float(np.interp(late, np.arange(6), CURVE))
        for _ in range(400):
            paid = EpisodeRewards(hours(rng, street, agents), hours(rng, CURVE, agents))
            matched = match_delays(paid, np.full(agents, min(late, 1.0)))
            taken.append(matched.chance < CHANCE)
            assert taken[-1] or not matched.beyond_s.any()
    assert np.mean(found[0.0]) < 0.07 and np.mean(found[1.0]) < 0.07
    assert np.mean(found[4.0]) > 0.95  # where lost time says 1 s


@pytest.mark.slow
def test_a_planted_delay_is_found() -> None:
    make = partial(parallel_env, "single-v1", **SIGHT)
    env = make()
    policy, agents = make_rule("largest-queue:20", env), env.possible_agents
    env.close()
    sim = SimulatedWorld(make, "sim", 1, 0.3, 4)
    logs = sim.under_delays(policy, 0, 3, list)
    for late, log in enumerate(logs):
        assert set(log.frame["delay_s"].to_list()) == {0.0, float(late)} and log.episodes == 2
    simulated = np.array([episode_rewards(log, agents) for log in logs])
    for planted_s in (0, 3):
        street = partial(parallel_env, "single-v1", f"late_green=*,{planted_s}", **SIGHT)
        real = SimulatedWorld(street, "real", 2, 0.3)
        log = real.collect(policy, 0, 3)
        assert log is not None
        paid = EpisodeRewards(episode_rewards(log, agents), simulated)
        found = match_delays(paid, np.zeros(1))  # where nothing is known of a lost time
        assert found.delay_s == pytest.approx([planted_s], abs=1.2)  # an hour is one sample
        assert (found.beyond_s == found.delay_s * (planted_s > 0)).all()


def test_all_delays_of_an_intersection_move_together(tmp_path: Path) -> None:
    plain = TimedTransform(LAYOUTS, 1)
    moved = TimedTransform(LAYOUTS, 1, timed=TimedConfig(match=True))
    for transform in (plain, moved):
        for model in (transform.forward, transform.simulated, transform.inverse):
            model.fitted.fill_(True)
        transform.constants.delay_s.copy_(torch.tensor([[1.0, 2.0], [4.0, 0.5]]))
    moved.constants.beyond_s.copy_(torch.tensor([[1.5], [3.0]]))
    observations = torch.zeros(2, 1, 4)
    observations[:, 0, 2] = 1.0  # the first phase is shown, the second asked for
    asked, two = np.array([1, 1]), np.ones((2, 2), dtype=np.bool_)
    with torch.no_grad():
        usual, later = (t.ground(observations, asked, two, ()).delay_s for t in (plain, moved))
    assert usual is not None and later is not None
    assert later == pytest.approx(np.clip(usual + np.array([1.5, 3.0]), 0.0, 5.0), abs=1e-6)
    moved.save(tmp_path / "moved.pt")
    again = TimedTransform(LAYOUTS, 2, timed=TimedConfig(match=True))
    again.load(tmp_path / "moved.pt")
    assert again.constants.beyond_s.equal(moved.constants.beyond_s)
    with pytest.raises(CheckpointError):
        TimedTransform(LAYOUTS, 2).load(tmp_path / "moved.pt")


def test_phase_grounding_matches_no_rewards() -> None:
    assert UgatConfig("timed", timed=TimedConfig(match=True)).matches
    assert not UgatConfig("phase", timed=TimedConfig(match=True)).matches
