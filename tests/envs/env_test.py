"""The environment itself: agents, actions, the end of episodes, options, pictures."""

from __future__ import annotations

import contextlib
import copy
import json
import math
import pickle
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ugat_marl
from ugat_marl.effects import StartupDelay, load_scenario
from ugat_marl.envs import EnvOptions, TrafficEnv, parallel_env, rewards
from ugat_marl.envs.signal_programmes import ProgrammePhases
from ugat_marl.errors import (
    ActionError,
    EpisodeError,
    OptionError,
    ScenarioError,
    SimulatorError,
    UnknownNameError,
)
from ugat_marl.policies import make_rule, observer_of, roll_out
from ugat_marl.scenarios import Network
from ugat_marl.simulation import Snapshot
from ugat_marl.testing.episodes import play, random_actions


@pytest.fixture(scope="module")
def mixed() -> Iterator[TrafficEnv]:
    """Seven unequal intersections; kept for the module, so that restarting SUMO is cheap."""
    env = ugat_marl.parallel_env("mixed-v1", duration_s=60)
    env.reset(seed=0)
    yield env
    env.close()


def whole_episode(env: TrafficEnv, seed: int = 1) -> Any:
    return play(env, seed, random_actions(seed), 1000)


# --- agents -------------------------------------------------------------------------------------


def test_equal_intersections_are_one_group() -> None:
    env = ugat_marl.parallel_env("grid2x2-v1")
    assert env.possible_agents == ["signal_0", "signal_1", "signal_2", "signal_3"]
    assert env.agent_groups == {"signal": env.possible_agents}
    assert list(env.intersection_of.values()) == [item.id for item in env.network.intersections]
    assert {env.action_space(agent).n for agent in env.possible_agents} == {8}


def test_unequal_intersections_have_their_own_spaces(mixed: TrafficEnv) -> None:
    network = Network.read(ugat_marl.load_scenario("mixed-v1"))
    assert len({len(item.phases) for item in network.intersections}) >= 4
    assert len(mixed.possible_agents) == len(network.intersections) == 7
    for agent in mixed.possible_agents:
        item = network.intersection(mixed.intersection_of[agent])
        assert mixed.action_space(agent).n == len(item.phases)
        assert mixed.layouts[agent].features == len(item.incoming_lanes)
        assert mixed.layouts[agent].phases == len(item.phases)
        assert mixed.observation_space(agent).shape == (mixed.layouts[agent].size,)
    sizes = {
        group: {(mixed.layouts[agent].features, mixed.layouts[agent].phases) for agent in own}
        for group, own in mixed.agent_groups.items()
    }
    assert len(sizes) > 2 and all(len(own) == 1 for own in sizes.values())
    assert [group[:6] for group in sizes] == ["signal"] * len(sizes)


def test_both_facades_stay_functions_after_use() -> None:
    """A module of the same name once took the place of `ugat_marl.env`."""
    for _ in range(2):
        ugat_marl.parallel_env("single-v1").close()
        aec = ugat_marl.env("single-v1", duration_s=60)
        assert aec.metadata["name"] == "ugat_marl_v1"
        aec.close()


# --- actions ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda n: n, r"is 3; allowed: the integers 0 to 2"),
        (lambda n: -1, r"is -1; allowed"),
        (lambda n: 1.0, r"is 1.0; allowed"),
        (lambda n: float("nan"), r"is nan; allowed"),
        (lambda n: "north", r"is 'north'; allowed"),
        (lambda n: None, r"is None; allowed"),
        (lambda n: np.array([1]), r"is array\(\[1\]\); allowed"),
    ],
)
def test_impossible_actions_are_refused_before_anything_moves(
    mixed: TrafficEnv, wrong: Any, message: str
) -> None:
    mixed.reset(seed=1)
    agent = next(a for a in mixed.agents if mixed.action_space(a).n == 3)
    right = dict.fromkeys(mixed.agents, 0)
    before = mixed.snapshot
    with pytest.raises(ActionError, match=rf"action of agent '{agent}' {message}"):
        mixed.step({**right, agent: wrong(3)})
    assert mixed.snapshot is before
    mixed.step(right)  # the episode goes on


def test_missing_and_unknown_agents_are_named(mixed: TrafficEnv) -> None:
    mixed.reset(seed=1)
    right = dict.fromkeys(mixed.agents, 0)
    last = mixed.agents[-1]
    with pytest.raises(ActionError, match=f"no action for agent '{last}'"):
        mixed.step({a: 0 for a in right if a != last})
    with pytest.raises(ActionError, match=r"unknown agents \['signal_9'\]"):
        mixed.step({**right, "signal_9": 0})
    for nothing in (None, [0, 0]):
        with pytest.raises(ActionError, match=r"actions are .*; give a dictionary"):
            mixed.step(nothing)  # pyright: ignore[reportArgumentType]


def test_what_learners_hand_over_is_accepted(mixed: TrafficEnv) -> None:
    episodes = []
    for kind in (int, np.int64, np.uint8, np.array):
        mixed.reset(seed=1)
        episodes.append(mixed.step({agent: kind(1) for agent in mixed.agents})[0])
    for other in episodes[1:]:
        for agent, seen in other.items():
            np.testing.assert_array_equal(seen, episodes[0][agent])


def test_the_executed_phase_is_told_and_observed(mixed: TrafficEnv) -> None:
    mixed.reset(seed=1)
    chosen = {agent: int(mixed.action_space(agent).n) - 1 for agent in mixed.agents}
    seen, _, _, _, infos = mixed.step(chosen)
    for agent, layout in mixed.layouts.items():
        assert infos[agent]["executed_action"] == chosen[agent]
        shown = seen[agent][layout.features : layout.features + layout.phases]
        assert shown.tolist() == [0.0] * (layout.phases - 1) + [1.0]


def test_a_held_green_masks_every_other_phase() -> None:
    scenario = ugat_marl.load_scenario("single-v1").with_control(min_green_s=30)
    env = ugat_marl.parallel_env(scenario, duration_s=100)
    _, infos = env.reset(seed=1)
    assert infos["signal_0"]["action_mask"].all()
    masks, executed = [], []
    for action in (3, 5, 5, 5, 5, 5):
        _, _, _, _, infos = env.step({"signal_0": action})
        masks.append(int(infos["signal_0"]["action_mask"].sum()))
        executed.append(infos["signal_0"]["executed_action"])
    # Clearing takes 5 s: green begins at 5 s and is held until 35 s, so that the request of the
    # decision at 30 s is the first that can be begun.
    assert executed == [3, 3, 3, 5, 5, 5]
    assert masks[:3] == [1, 1, 8]
    env.close()


# --- the end of an episode ----------------------------------------------------------------------


def test_a_delay_at_every_decision_is_late_green() -> None:
    def trajectory(domain: str, delay_s: float | None) -> list[Any]:
        env = ugat_marl.parallel_env("single-v1", domain, duration_s=300)
        seen: list[Any] = []
        env.reset(seed=4)
        while env.agents:
            if delay_s is not None:
                env.delay_greens(dict.fromkeys(env.agents, delay_s))
            env.step(dict.fromkeys(env.agents, len(seen) // 3 % 4))
            seen.append(env.snapshot.vehicles.tolist())
        env.close()
        return seen

    assert trajectory("sim", 2.0) == trajectory("late_green=*,2", None)
    assert trajectory("sim", 0.0) == trajectory("sim", None) != trajectory("sim", 2.0)


def test_an_array_of_actions_is_refused(mixed: TrafficEnv) -> None:
    mixed.reset(seed=1)
    with pytest.raises(ActionError, match="give a dictionary with the agents as its keys"):
        mixed.step(np.zeros(7, int))  # type: ignore[arg-type]


def test_more_commands_than_an_observation_holds_are_refused() -> None:
    with pytest.raises(OptionError, match="commands = 5000, neighbours = 0: .* at most 32767"):
        parallel_env("single-v1", commands=5000)


def test_impossible_delays_are_refused(mixed: TrafficEnv) -> None:
    mixed.close()
    for call in (mixed.delay_greens, mixed.remember):
        with pytest.raises(EpisodeError, match="call reset"):
            call({})
    mixed.reset(seed=1)
    agent = mixed.agents[0]
    with pytest.raises(ActionError, match="unknown agents \\[3, 'nobody'\\]"):
        mixed.delay_greens({"nobody": 1.0, 3: 1.0})  # type: ignore[dict-item]
    delays: list[Any] = [-1.0, float("nan"), float("inf"), "1", None]
    for delay in delays:
        with pytest.raises(ActionError, match="0 or more"):
            mixed.delay_greens({agent: delay})


def test_an_episode_has_as_many_steps_as_its_duration() -> None:
    env = ugat_marl.parallel_env("single-v1", duration_s=75)  # the last 5 s are no whole decision
    episode = whole_episode(env)
    assert len(episode.actions) == 7
    assert env.snapshot.time_s == 70
    assert not env.agents
    env.close()


def test_after_the_end_only_reset_and_looking_back_make_sense(mixed: TrafficEnv) -> None:
    episode = whole_episode(mixed)
    state = mixed.state()
    assert mixed.state_space.contains(state)
    last = episode.moments[-1].observations
    np.testing.assert_array_equal(state, np.concatenate([last[a] for a in mixed.possible_agents]))
    assert mixed.scores() == episode.scores
    with pytest.raises(EpisodeError, match=r"call reset\(\) first"):
        mixed.step(dict.fromkeys(mixed.possible_agents, 0))
    assert mixed.step({}) == ({}, {}, {}, {}, {})  # nobody acts, nobody is told anything
    mixed.reset()
    with pytest.raises(EpisodeError, match="whole episode of 6 steps"):
        mixed.scores()
    with pytest.raises(ActionError):
        mixed.step({})


def test_before_reset_nothing_has_a_meaning() -> None:
    env = ugat_marl.parallel_env("single-v1")
    assert env.agents == []
    for call in (
        env.state, env.scores, lambda: env.step({}), lambda: env.step({"signal_0": 0}),
        lambda: env.snapshot, lambda: env.seen,
    ):  # fmt: skip
        with pytest.raises(EpisodeError):
            call()
    env.close()


def test_scores_are_those_of_the_episode(mixed: TrafficEnv) -> None:
    episode = whole_episode(mixed)
    scores = mixed.scores()
    given = [np.mean(list(moment.parts["rewards"].values())) for moment in episode.moments[1:]]
    assert scores.reward == pytest.approx(np.mean(given))
    assert scores.queue == pytest.approx(-scores.reward)
    assert scores.due == scores.departed + scores.backlog >= scores.throughput
    assert scores.departed == mixed.snapshot.departed
    assert scores.att_s > 0 and scores.delay_s > 0 and 0 < scores.delay < 1


# --- options ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"obervation": "count"}, UnknownNameError, "mean 'observation'"),
        ({"observation": "counts"}, UnknownNameError, "mean 'count'"),
        ({"reward": "wait"}, UnknownNameError, "mean 'waiting'"),
        ({"domain": "V5"}, UnknownNameError, "mean 'V"),
        ({"domain": "snwo"}, UnknownNameError, "mean 'snow'"),
        ({"domain": "startup_delai=1"}, UnknownNameError, "mean 'startup_delay'"),
        ({"domain": "startup_delay=99"}, OptionError, r"outside \[0, 10\] s"),
        ({"domain": ["V1"]}, OptionError, "'V1' is not an effect; give a name such as 'V1' on its"),
        ({"domain": Path("x")}, OptionError, "give a scenario directory as text"),
        ({"observation": None}, UnknownNameError, "observation 'None'. Known: count"),
        ({"reward": None}, UnknownNameError, "reward 'None'. Known: pressure"),
        ({"signals": "programm"}, UnknownNameError, "'signals'.* mean 'programme'"),
        ({"simulator": "proces"}, UnknownNameError, "mean 'process'"),
        ({"render_mode": "rgb"}, UnknownNameError, "mean 'rgb_array'"),
        ({"neighbours": -1}, OptionError, "neighbours = -1"),
        ({"neighbours": 1.5}, OptionError, "neighbours = 1.5"),
        ({"fitted": None}, OptionError, "fitted = None: must be parts"),
        ({"fitted": [5]}, OptionError, "must be parts of a fitted street"),
        ({"crossings": "no"}, OptionError, "crossings = 'no': must be True or False"),
        ({"duration_s": 5}, ScenarioError, "shorter than one decision"),
        ({"duration_s": -5}, ScenarioError, "duration_s = -5"),
    ],
)
def test_impossible_options_name_the_way_out(
    options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        ugat_marl.parallel_env("single-v1", **options)


def test_an_unknown_scenario_names_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="mean 'grid2x2-v1'"):
        ugat_marl.parallel_env("grid2x2")


def test_the_domain_decides_the_scenario() -> None:
    sim = ugat_marl.parallel_env("single-v1")
    rain = ugat_marl.parallel_env("single-v1", "rain")
    assert (sim.domain, rain.domain) == ("sim", "V3")
    assert sim.scenario.hash != rain.scenario.hash
    assert ugat_marl.parallel_env("single-v1", "V3").scenario.hash == rain.scenario.hash
    listed = ugat_marl.parallel_env("single-v1", [StartupDelay(2.0)])
    assert listed.domain == "startup_delay=2"
    assert listed.scenario.applied == ("startup_delay=2",)


def test_numbers_of_numpy_become_plain_ones() -> None:
    one: Any = np.int64(1)
    options = EnvOptions(
        neighbours=one, commands=one, duration_s=np.float32(20), deadline_s=one,  # type: ignore[arg-type]
        crossings=np.bool_(True),  # type: ignore[arg-type]
    )  # fmt: skip
    named = [options.neighbours, options.commands, options.duration_s, options.deadline_s]
    assert json.dumps([*named, options.crossings]) == "[1, 1, 20.0, 1, true]"


def test_an_observation_that_fails_begins_no_episode() -> None:
    fails = False

    def watched(view: Any) -> Any:
        if fails:
            raise ValueError("planted")
        return view.vehicles

    env = ugat_marl.parallel_env("single-v1", observation=watched, duration_s=20)
    fails = True
    with pytest.raises((ValueError, OptionError), match="planted"):
        env.reset(seed=1)
    assert env.agents == []
    with pytest.raises(EpisodeError, match="call reset"):
        env.step({"signal_0": 0})
    fails = False
    env.reset(seed=1)
    assert env.agents == ["signal_0"]
    env.close()


def test_neighbours_are_seen_by_those_who_have_any() -> None:
    env = ugat_marl.parallel_env("grid2x2-v1", neighbours=1, duration_s=60)
    own = env.layouts["signal_0"].features + env.layouts["signal_0"].phases
    assert {layout.context for layout in env.layouts.values()} == {2 * own}
    seen, _ = env.reset(seed=1)
    seen, *_ = env.step({"signal_0": 1, "signal_1": 2, "signal_2": 3, "signal_3": 4})
    ids = {tls: agent for agent, tls in env.intersection_of.items()}
    for agent, tls in env.intersection_of.items():
        near = [ids[other] for other in env.network.intersection(tls).neighbours]
        expected = np.concatenate([seen[a][:own] for a in (agent, *near)])
        np.testing.assert_array_equal(seen[agent], expected)
    assert env.env_options == {"observation": "count", "neighbours": 1}
    env.close()


def minus_vehicles(before: rewards.IntersectionView, after: rewards.IntersectionView) -> float:
    return -float(after.vehicles.sum())


def test_every_reward_is_what_it_says(mixed: TrafficEnv) -> None:
    lanes = mixed.network.lane_table().ids
    rng = np.random.default_rng(0)

    def snapshot(time_s: float) -> Snapshot:
        vehicles, halting, waiting_s, upstream = rng.integers(1, 30, (4, len(lanes))).astype(float)
        speed_mps = np.ones(len(lanes))
        return Snapshot(
            time_s, vehicles, halting, speed_mps, waiting_s, 0, 0, queued_upstream=upstream
        )

    def on(names: tuple[str, ...], values: np.ndarray) -> float:
        return sum(values[lanes.index(name)] for name in names)

    before, after = snapshot(0.0), snapshot(10.0)
    more_in: set[bool] = set()
    given = {
        name: rewards.Rewarder(mixed.network, name).rewards(before, after)
        for name in ("queue", "total-queue", "pressure", "waiting")
    }
    for place, item in enumerate(mixed.network.intersections):
        incoming, outgoing = item.incoming_lanes, item.outgoing_lanes
        queue, upstream = on(incoming, after.halting), on(incoming, after.queued_upstream)
        difference = on(incoming, after.vehicles) - on(outgoing, after.vehicles)
        more_in.add(difference > 0)
        assert given["queue"][place] == -queue
        assert given["total-queue"][place] == -queue - upstream
        assert given["pressure"][place] == -abs(difference)
        waits_s = [on(incoming, moment.waiting_s) for moment in (before, after)]
        assert given["waiting"][place] == waits_s[0] - waits_s[1]
    assert more_in == {True, False}


def test_the_reward_may_be_a_function() -> None:
    env = ugat_marl.parallel_env("single-v1", reward=minus_vehicles, duration_s=200)
    seen, _ = env.reset(seed=1)
    while env.agents:
        seen, given, *_ = env.step({"signal_0": 0})
        features = seen["signal_0"][: env.layouts["signal_0"].features]
        assert features.max() < 1  # nothing is clipped
        assert given["signal_0"] == pytest.approx(-40 * float(features.sum()), abs=1e-4)
    assert given["signal_0"] < 0
    env.close()


@pytest.mark.parametrize("wrong", [math.nan, None, "much", [1.0, 2.0]])
def test_a_reward_that_is_no_number_is_refused(wrong: Any) -> None:
    with contextlib.closing(
        ugat_marl.parallel_env("single-v1", reward=lambda *_: wrong, duration_s=100)
    ) as env:
        env.reset(seed=1)
        with pytest.raises(OptionError, match="must return one finite number"):
            env.step({"signal_0": 0})
        assert env.agents == []


def test_under_the_networks_own_programme_actions_say_nothing() -> None:
    episodes = []
    for seed in (1, 2):
        env = ugat_marl.parallel_env("single-v1", signals="programme", duration_s=120)
        episodes.append(play(env, 7, random_actions(seed), 100))
        assert env.scores().throughput > 0
        env.close()
    assert episodes[0].actions != episodes[1].actions
    for a, b in zip(episodes[0].moments, episodes[1].moments, strict=True):
        np.testing.assert_array_equal(a.observations["signal_0"], b.observations["signal_0"])


def test_under_a_programme_the_observation_shows_the_green_of_the_light() -> None:
    """The programme has two through greens, which are phases, and two left turns, which are none.

    27 s through, 3 s yellow, 10 s left, 3 s yellow, 2 s red, and the same for the other road.
    """
    env = ugat_marl.parallel_env("single-v1", signals="programme", duration_s=110)
    layout = env.layouts["signal_0"]
    observations, _ = env.reset(seed=1)
    one_hots = [observations["signal_0"][layout.features : layout.features + layout.phases]]
    phases, executed = [env.phases[0]], [0]
    while env.agents:
        observations, _, _, _, infos = env.step({"signal_0": 5})
        one_hots.append(observations["signal_0"][layout.features :])
        phases.append(env.phases[0])
        executed.append(infos["signal_0"]["executed_action"])
    at_s = dict(zip(range(0, 120, 10), phases, strict=True))
    assert (at_s[10], at_s[20]) == (0, 0) and at_s[40] == -1
    assert (at_s[50], at_s[70]) == (1, 1) and at_s[80] == -1
    assert (at_s[100], at_s[110]) == (0, 0)
    for vector, phase in zip(one_hots, phases, strict=True):
        assert np.flatnonzero(vector).tolist() == ([phase] if phase >= 0 else [])
    assert executed[4] == 0 and executed[8] == 1  # the last phase of its own
    env.close()
    scenario = env.scenario.with_control(phases="programme")
    env = ugat_marl.parallel_env(scenario, signals="programme", duration_s=110)
    env.reset(seed=1)
    shown: set[int] = set(env.phases)
    while env.agents:
        env.step({"signal_0": 0})
        shown.add(env.phases[0])
    assert shown == {0, 1, 2, 3}
    env.close()


@pytest.mark.parametrize("letter", ["y", "Y", "u"])
def test_a_light_that_changes_shows_no_other_green(letter: str) -> None:
    """One link stays green while the others change, in any of SUMO's letters for that."""
    network = Network.read(load_scenario("single-v1"))
    light = network.intersections[0]
    green = light.phases[0]
    changing = list(green.replace("G", letter).replace("g", letter))
    changing[green.index("G")] = "G"
    seen = ProgrammePhases(network)
    for state in (green, "".join(changing)):
        seen.look({light.id: state})
        assert seen.shown == [0]
    seen.look({light.id: "".join(changing).replace(letter, "r")})
    assert seen.shown == [-1]


def test_a_scenario_is_found_after_a_change_of_folder(
    crossing: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = crossing()
    monkeypatch.chdir(directory.parent)
    env = ugat_marl.parallel_env(directory.name)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    env.reset(seed=1)
    env.close()


# --- pictures -----------------------------------------------------------------------------------


def test_pictures_show_the_traffic() -> None:
    env = ugat_marl.parallel_env("single-v1", render_mode="rgb_array", duration_s=120)
    env.reset(seed=1)
    empty = env.render()
    assert empty.dtype == np.uint8 and empty.shape[2] == 3 and empty.shape[0] > 100
    assert 0.02 < (empty != 255).any(axis=2).mean() < 0.9  # roads, and something beside them
    env.step({"signal_0": 0})
    np.testing.assert_array_equal(env.render(), env.render())
    while env.agents:
        env.step({"signal_0": 4})
    last = env.render()  # the episode is over, its last moment stays
    assert last.shape == empty.shape
    assert (last != empty).any(axis=2).sum() > 20
    env.close()


def test_nothing_is_drawn_unasked(mixed: TrafficEnv) -> None:
    mixed.reset(seed=1)
    assert mixed.render_mode is None and mixed.render() is None


@pytest.mark.parametrize("simulator", ["process", "inprocess"])
def test_a_window_without_a_display_is_a_clear_error(
    simulator: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """sumo-gui itself would end the process, and in-process the user's."""
    monkeypatch.delenv("DISPLAY", raising=False)
    env = ugat_marl.parallel_env("single-v1", render_mode="human", simulator=simulator)
    with pytest.raises(SimulatorError, match="DISPLAY is not set.*rgb_array"):
        env.reset(seed=1)
    env.close()


# --- life ---------------------------------------------------------------------------------------


def test_it_can_be_sent_to_another_process_before_reset() -> None:
    env = ugat_marl.parallel_env("mixed-v1", "V2", duration_s=60, reward=minus_vehicles)
    copy = pickle.loads(pickle.dumps(env))  # noqa: S301
    a, b = whole_episode(env), whole_episode(copy)
    assert a.scores == b.scores
    env.close()
    copy.close()


def test_an_episode_without_vehicles_at_its_beginning_is_a_warning() -> None:
    scenario = ugat_marl.load_scenario("single-v1")
    late = scenario.routes[0].read().replace(b'depart="', b'depart="1')
    scenario = replace(scenario, routes=(scenario.routes[0].edited(late),))
    env = ugat_marl.parallel_env(scenario, duration_s=100)
    env.reset(seed=1)
    with pytest.warns(UserWarning, match="no vehicle has entered the network in the first 10 s"):
        env.step({"signal_0": 0})
    env.close()


def test_an_error_of_a_reward_ends_the_episode() -> None:
    calls: list[int] = []

    def reward(before: Snapshot, after: Snapshot) -> float:
        calls.append(1)
        if len(calls) == 3:
            raise ValueError("planted")
        return float(after.halting.sum() - before.halting.sum())

    env = parallel_env("single-v1", duration_s=60, reward=reward)
    env.reset(seed=1)
    for _ in range(2):
        env.step({"signal_0": 0})
    with pytest.raises(ValueError, match="planted"):
        env.step({"signal_0": 0})
    assert env.agents == []
    with pytest.raises(EpisodeError, match="call reset"):
        env.step({"signal_0": 0})
    with pytest.raises(EpisodeError, match="whole episode"):
        env.scores()
    env.close()


def test_a_reset_that_fails_leaves_no_scores_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    env = parallel_env("single-v1", duration_s=20)
    env.reset(seed=1)
    while env.agents:
        env.step({"signal_0": 0})
    env.scores()

    def fails(*_: Any) -> None:
        raise SimulatorError("planted")

    monkeypatch.setattr(env._simulator, "start", fails)
    with pytest.raises(SimulatorError, match="planted"):
        env.reset(seed=2)
    with pytest.raises(EpisodeError, match="whole episode"):
        env.scores()
    with pytest.raises(EpisodeError, match="call reset"):
        env.step({})
    env.close()


def test_what_a_recording_reads_is_measured() -> None:
    env = parallel_env("single-v1", "V4", duration_s=100)
    other = parallel_env("single-v1", "V4", duration_s=100, observation="waiting")
    rule = make_rule("fixed-time:20", env)
    observer = observer_of(env, "waiting")
    logs = [roll_out(each, rule, 1, record=observer).log for each in (env, other)]
    env.close()
    other.close()
    assert logs[0] is not None and logs[1] is not None
    first, second = (log.transitions(log.agents[0]) for log in logs)
    assert np.array_equal(first.observation, second.observation)
    assert first.observation[-1].max() > 0


def test_an_environment_is_copied_before_its_simulation_only(crossing: Callable[..., Path]) -> None:
    env = parallel_env(crossing())
    for copied in (copy.copy(env), copy.deepcopy(env)):
        copied.reset(seed=1)
        copied.close()
    env.reset(seed=1)
    for make in (copy.copy, copy.deepcopy):
        with pytest.raises(EpisodeError, match="cannot be copied after reset"):
            make(env)
    env.step(dict.fromkeys(env.agents, 0))
    env.close()


@pytest.mark.parametrize("seed", [np.array(2), np.int64(2), True])
def test_a_seed_is_any_whole_number(seed: Any) -> None:
    env = parallel_env("single-v1", duration_s=60)
    ends: list[Any] = []
    for same in (seed, int(seed)):
        env.reset(seed=same)
        for _ in range(6):
            seen, *_ = env.step(dict.fromkeys(env.agents, 0))
        ends.append(next(iter(seen.values())))
    assert ends[0].tolist() == ends[1].tolist() and ends[0].any()
    env.close()


@pytest.mark.parametrize("seed", [-1, 1.5, np.array([1, 2]), "1"])
def test_other_seeds_are_refused(seed: Any) -> None:
    env = parallel_env("single-v1", duration_s=20)
    with pytest.raises(OptionError, match="must be a whole number from 0 on"):
        env.reset(seed=seed)
