"""The action gap: late and lost commands, the order of phases, shortest and longest greens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import libsumo
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import ugat_marl
from ugat_marl.effects import (
    LaneService,
    load_scenario,
    parse_domain,
    scenario_in_domain,
    service_of,
    withheld,
)
from ugat_marl.effects.actuators import ACTING, PHASE_ORDERS, successors
from ugat_marl.effects.table import ON_CONTROLLERS
from ugat_marl.envs.actuators import Actuators
from ugat_marl.errors import OptionError, ScenarioError, UnknownNameError
from ugat_marl.grounding import FittedService
from ugat_marl.scenarios import Network, signals, validate_settings
from ugat_marl.testing.episodes import play, random_actions

NETWORKS = {name: Network.read(load_scenario(name)) for name in ("single-v1", "mixed-v1")}
TIMING = signals.SignalTiming(3.0, 2.0, 5.0)
EXAMPLES = (
    "execution_delay=30", "lost_commands=0.2", "phase_order=cyclic", "max_green=40", "min_green=15",
)  # fmt: skip


def actuators(domain: str, name: str = "single-v1", seed: int = 1) -> Actuators:
    made = Actuators.of(parse_domain(domain), NETWORKS[name], TIMING, 10.0)
    assert made is not None
    made.reset(seed)
    return made


def test_a_longest_green_below_that_of_one_decision_is_refused() -> None:
    with pytest.raises(ScenarioError, match="max_green=20: a green of one decision is 25 s"):
        Actuators.of(parse_domain("max_green=20"), NETWORKS["single-v1"], TIMING, 30.0)


def test_a_longest_green_below_the_minimum_green_is_refused() -> None:
    with pytest.raises(ScenarioError, match="max_green=40: the minimum green is 60 s"):
        Actuators.of(
            parse_domain("max_green=40"),
            NETWORKS["single-v1"],
            signals.SignalTiming(3.0, 2.0, 60.0),
            10.0,
        )


class Light:
    """One intersection behind its actuators and its signal machine, second by second."""

    def __init__(self, domain: str, timing: signals.SignalTiming = TIMING) -> None:
        self.actuators = actuators(domain)
        self.timing = timing
        self.phases = NETWORKS["single-v1"].intersections[0].phases
        self.state = signals.initial_state(timing)
        self.shown: list[str] = []
        self.asked: list[int] = []

    @property
    def allowed(self) -> set[int]:
        """What the mask allows now."""
        return set(np.flatnonzero(self.actuators.masks([self.state])[0]).tolist())

    def step(self, command: int) -> int:
        """Gives a command; returns the phase that is shown or cleared towards afterwards."""
        (asked,) = self.actuators.obey([command], [self.state])
        self.asked.append(asked)
        self.state, segments = signals.advance(self.phases, self.state, asked, 10.0, self.timing)
        for seconds, shown in segments:
            self.shown += [shown] * round(seconds)
        return self.state.phase

    def lengths(self) -> list[tuple[int, str]]:
        """Seconds each state was shown without a break, the first and the last one left out."""
        found: list[tuple[int, str]] = []
        for shown in self.shown:
            if found and found[-1][1] == shown:
                found[-1] = (found[-1][0] + 1, shown)
            else:
                found.append((1, shown))
        return found[1:-1]


# --- values


def test_every_effect_has_an_example() -> None:
    assert [text.partition("=")[0] for text in EXAMPLES] == [kind.name for kind in ACTING]
    assert {kind.name for kind in ACTING} <= set(ON_CONTROLLERS)


@pytest.mark.parametrize("text", EXAMPLES)
def test_the_scenario_keeps_the_effect(text: str, tmp_path: Any) -> None:
    changed = scenario_in_domain(load_scenario("single-v1"), text)
    assert changed.hash != load_scenario("single-v1").hash
    assert load_scenario(load_scenario(changed.write(tmp_path / "written"))).hash == changed.hash


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("phase_order=cyclc", UnknownNameError, "Did you mean 'cyclic'"),
        ("phase_order=*", OptionError, "must be one phase order"),
        ("max_green=5", OptionError, r"seconds = 5.0 is outside \[10, 600\] s"),
    ],
)
def test_impossible_values(text: str, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        parse_domain(text)


def test_without_effects_there_is_nothing_to_do() -> None:
    assert Actuators.of(parse_domain("V4"), NETWORKS["single-v1"], TIMING, 10.0) is None
    scenario = load_scenario("single-v1")
    for asked, least in (("15", 15), ("2.5", 3), ("0.5", 1), ("0", 0)):
        changed = scenario_in_domain(scenario, f"min_green={asked}")
        assert changed.control.min_green_s == least, "at least as long, in whole steps"


# --- which phase may follow which

# Phases of single-v1: through on both streets, all of north, east, south, west, left turns of both.
NORTH_SOUTH, EAST_WEST = {0, 2, 4, 6}, {1, 3, 5, 7}


def test_the_phases_of_the_example_are_those_of_the_tables_below() -> None:
    assert NETWORKS["single-v1"].intersections[0].phases == (
        "GGGGrrrrrrGGGGrrrrrr", "rrrrrGGGGrrrrrrGGGGr", "GGGGGGrrrrGrrrrrrrrr",
        "rrrrrGGGGGGrrrrGrrrr", "GrrrrrrrrrGGGGGGrrrr", "GrrrrGrrrrrrrrrGGGGG",
        "GrrrGGrrrrGrrrGGrrrr", "GrrrrGrrrGGrrrrGrrrG",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("rule", "from_through", "from_other", "of_north"),
    [  # into the other street: out of the through phase 0, out of phases 2 and 6
        ("barrier-leading", {7}, {7}, {0, 4, 6}),
        ("barrier-lagging", EAST_WEST, set[int](), {0, 4, 6}),
        ("barrier-both", {7}, set[int](), {0, 4, 6}),
    ],
)
def test_barriers(
    rule: str, from_through: set[int], from_other: set[int], of_north: set[int]
) -> None:
    following = [set(x) for x in successors(NETWORKS["single-v1"].intersections[0], rule)]
    assert following[0] == {2, 4, 6} | from_through
    assert following[2] == of_north | from_other
    assert following[6] == {0, 2, 4} | from_other
    mirrored = {0: 1, 1: 0, 2: 3, 3: 2, 4: 5, 5: 4, 6: 7, 7: 6}
    for phase in range(8):
        assert following[mirrored[phase]] == {mirrored[other] for other in following[phase]}


def test_cyclic_and_free() -> None:
    item = NETWORKS["single-v1"].intersections[0]
    assert successors(item, "cyclic") == [[1], [2], [3], [4], [5], [6], [7], [0]]
    assert successors(item) == [[x for x in range(8) if x != phase] for phase in range(8)]


@pytest.mark.parametrize("rule", PHASE_ORDERS)
def test_every_phase_can_be_reached_from_every_other(rule: str) -> None:
    for network in NETWORKS.values():
        for item in network.intersections:
            following = successors(item, rule)
            reached = {0}
            for _ in item.phases:
                reached |= {other for phase in reached for other in following[phase]}
            assert reached == set(range(len(item.phases))), item.id


def test_phases_without_a_barrier_are_refused() -> None:
    scenario = load_scenario("single-v1")
    one_street = {"A1": {"phases": ["GGGGrrrrrrGGGGrrrrrr", "GGGGGGrrrrGrrrrrrrrr"]}}
    given_here = scenario.settings.model_dump() | {"intersections": one_street}
    changed = replace(scenario, settings=validate_settings(given_here, "here"))
    with pytest.raises(ScenarioError, match="'A1' have no barrier.*use 'cyclic'"):
        ugat_marl.parallel_env(changed, "phase_order=barrier-both")
    ugat_marl.parallel_env(changed, "phase_order=cyclic")


# --- what becomes of commands, by hand


def test_commands_arrive_late() -> None:
    light = Light("execution_delay=30")
    for command in (1, 2, 3, 4, 5, 6):
        light.step(command)
    assert light.asked == [0, 0, 0, 1, 2, 3]


def test_lost_commands() -> None:
    light = Light("lost_commands=1")
    assert [light.step(command) for command in (1, 2, 3)] == [0, 0, 0]
    light = Light("lost_commands=0.3")
    obeyed = 0
    for _ in range(2000):
        command = (light.state.phase + 1) % 8
        light.step(command)
        obeyed += light.asked[-1] == command
    assert obeyed / 2000 == pytest.approx(0.7, abs=0.03)


def test_a_command_out_of_order_is_not_obeyed() -> None:
    light = Light("phase_order=cyclic")
    assert light.allowed == {0, 1}
    assert light.step(3) == 0
    assert light.step(1) == 1
    assert light.allowed == {1, 2}
    assert light.step(0) == 1


def test_the_longest_green() -> None:
    light = Light("max_green=40")
    phases = [light.step(light.state.phase) for _ in range(20)]
    assert phases == [0] * 3 + [1] * 4 + [2] * 4 + [3] * 4 + [4] * 4 + [5]
    # Green begins 5 s after the decision: 35 s at the fourth look, and 45 s would be too much.
    assert light.allowed == set(range(8))
    greens = [seconds for seconds, shown in light.lengths() if shown in light.phases]
    assert greens == [35] * 4


def test_a_green_is_not_too_long_before_it_begins() -> None:
    """The green begins in 1 s and is 7 s old 8 s from now."""
    timing = signals.SignalTiming(5.0, 4.0, 5.0)
    made = Actuators.of(parse_domain("max_green=10"), NETWORKS["single-v1"], timing, 8.0)
    assert made is not None
    made.reset(1)
    (mask,) = made.masks([signals.SignalState(phase=1, origin=0, elapsed_s=8.0)])
    assert mask[1]


def test_what_is_too_long_follows_the_order_of_phases() -> None:
    light = Light("max_green=10+phase_order=barrier-both")
    found = [light.step(light.state.phase) for _ in range(6)]
    assert found == [2, 4, 6, 0, 2, 4], "from one street to the other only if asked"


# --- whatever happens, safely

DOMAINS = st.lists(
    st.sampled_from(
        ["execution_delay=20", "lost_commands=0.3", "phase_order=cyclic", "max_green=20",
         "phase_order=barrier-leading", "phase_order=barrier-lagging", "phase_order=barrier-both"]
    ),
    min_size=1, max_size=4,
)  # fmt: skip


def check_safe(shown: Sequence[str], timing: signals.SignalTiming) -> None:
    """Yellow between every green and red, for its time; no green shorter than the minimum."""
    for link in range(len(shown[0])):
        letters = "".join(state[link] for state in shown)
        runs = [letters[0]]
        for letter in letters[1:]:
            if letter == runs[-1][0] or {letter, runs[-1][0]} <= set("Gg"):
                runs[-1] += letter
            else:
                runs.append(letter)
        for before, run in zip(runs, runs[1:], strict=False):
            assert not (before[0] in "Gg" and run[0] == "r"), "green to red without yellow"
        for run in runs[1:-1]:
            if run[0] == "y":
                assert len(run) == timing.yellow_s
            elif run[0] in "Gg":
                assert len(run) >= timing.min_green_s


@given(
    domains=DOMAINS,
    commands=st.lists(st.integers(0, 7), min_size=5, max_size=40),
    min_green_s=st.sampled_from([0.0, 5.0, 12.0]),
)
def test_the_signal_machine_keeps_its_rules(
    domains: list[str], commands: list[int], min_green_s: float
) -> None:
    timing = signals.SignalTiming(3.0, 2.0, min_green_s)
    light = Light("+".join(domains), timing)
    made = Actuators.of(parse_domain("+".join(domains)), NETWORKS["single-v1"], timing, 10.0)
    assert made is not None
    made.reset(4)
    light.actuators = made
    for command in commands:
        assert light.allowed
        light.step(command)
    check_safe(light.shown, timing)


def test_the_check_of_safety_can_fail() -> None:
    with pytest.raises(AssertionError, match="without yellow"):
        check_safe(["Gr"] * 8 + ["rG"] * 8, TIMING)
    with pytest.raises(AssertionError):
        check_safe(["r"] * 3 + ["G"] * 4 + ["y"] * 3 + ["r"] * 3, TIMING)
    with pytest.raises(AssertionError):
        check_safe(["r"] * 3 + ["G"] * 9 + ["y"] * 2 + ["r"] * 3, TIMING)


@given(
    domains=DOMAINS.map(lambda all_of: [x for x in all_of if "lost" not in x]).filter(len),
    choices=st.lists(st.integers(0, 7), min_size=5, max_size=30),
)
def test_masks_tell_what_will_be_obeyed(domains: list[str], choices: list[int]) -> None:
    light = Light("+".join(domains))
    late = 2 if "execution_delay=20" in domains else 0
    given_at: list[tuple[int, bool]] = []
    for choice in choices:
        given_at.append((choice, choice in light.allowed))
        light.step(choice)
        if len(given_at) > late:
            command, allowed = given_at[-1 - late]
            assert (light.asked[-1] == command) == allowed


# --- in the running environment


def test_late_commands_are_read_back_from_the_running_simulation() -> None:
    env = ugat_marl.parallel_env(
        "single-v1", "execution_delay=20", duration_s=120, simulator="inprocess"
    )
    try:
        env.reset(seed=1)
        phases = env.network.intersections[0].phases
        shown: list[int] = []
        for command in (3, 3, 3, 6, 6, 6, 6):
            _, _, _, _, infos = env.step({"signal_0": command})
            shown.append(phases.index(libsumo.trafficlight.getRedYellowGreenState("A1")))
            assert infos["signal_0"]["executed_action"] == shown[-1]
    finally:
        env.close()
    assert shown == [0, 0, 3, 3, 3, 6, 6]


@pytest.mark.parametrize("text", ["phase_order=cyclic", "phase_order=barrier-both+max_green=30"])
def test_an_agent_that_keeps_to_its_mask_is_obeyed(text: str) -> None:
    env = ugat_marl.parallel_env("mixed-v1", text, duration_s=300)
    try:
        played = play(env, 2, random_actions(2), 1000)
    finally:
        env.close()
    changed = 0
    for before, after in zip(played.moments, played.moments[1:], strict=False):
        for agent, action in (after.actions or {}).items():
            assert before.infos[agent]["action_mask"][action]
            assert after.infos[agent]["executed_action"] == action
            changed += before.infos[agent]["executed_action"] != action
    assert changed > 50


def test_lost_commands_follow_the_seed() -> None:
    env = ugat_marl.parallel_env("single-v1", "lost_commands=0.5", duration_s=200)
    try:
        first, same, other = (
            [
                moment.infos["signal_0"]["executed_action"]
                for moment in play(env, seed, lambda step, *_: {"signal_0": step % 8}, 99).moments
            ]
            for seed in (1, 1, 2)
        )
    finally:
        env.close()
    assert first == same != other


def test_the_network_s_own_programme_takes_no_commands() -> None:
    scores: list[Any] = []
    for domain in ("sim", "execution_delay=60+phase_order=cyclic"):
        env = ugat_marl.parallel_env("single-v1", domain, duration_s=200, signals="programme")
        try:
            scores.append(play(env, 1, lambda *_: {"signal_0": 0}, 99).scores)
        finally:
            env.close()
    assert scores[0] == scores[1]


def test_agents_see_their_last_commands_while_these_are_under_way() -> None:
    env = ugat_marl.parallel_env("single-v1", "execution_delay=20", duration_s=60, commands=2)
    try:
        observations, _ = env.reset(seed=1)
        width = len(observations["signal_0"])
        seen: list[list[int]] = []
        for command in (3, 6, 1):
            observations, *_ = env.step({"signal_0": command})
            vector = observations["signal_0"]
            assert env.observation_space("signal_0").contains(vector)
            one_hots = vector[width - 17 : width - 1].reshape(2, 8)
            seen.append([int(row.argmax()) if row.any() else -1 for row in one_hots])
        assert env.env_options["commands"] == 2
    finally:
        env.close()
    assert seen == [[3, -1], [6, 3], [1, 6]]


def test_the_service_of_one_lane_is_withheld_there_alone() -> None:
    """Nine seconds reach over the first decision, in which the green has five."""
    env = ugat_marl.parallel_env("single-v1", duration_s=60)
    item = env.network.intersections[0]
    env.close()
    phase, state = next((k, p) for k, p in enumerate(item.phases) if k and p.count("G") > 1)
    lane, other = [link for link in item.links if state[link.index] == "G"][:2]
    domain = f"lane_service={lane.from_lane},9,0"
    env = ugat_marl.parallel_env("single-v1", domain, duration_s=60, simulator="inprocess")
    try:
        env.reset(seed=1)
        shown: list[str] = []
        for _ in range(2):
            env.step({"signal_0": phase})
            shown.append(libsumo.trafficlight.getRedYellowGreenState(item.id))
    finally:
        env.close()
    assert lane.from_lane != other.from_lane
    assert [state[lane.index] for state in shown] == ["r", "G"]
    assert [state[other.index] for state in shown] == ["G", "G"]


def test_commands_are_late_before_they_are_lost_however_that_is_named() -> None:
    """The chance that a command is lost is drawn when it arrives."""
    late, lost = "execution_delay=20", "lost_commands=0.5"
    found: list[list[int]] = []
    for domain in (f"{late}+{lost}", f"{lost}+{late}"):
        light = Light(domain)
        found.append([light.step(command % 8) for command in range(1, 60)])
    assert found[0] == found[1]


def test_fitted_service_is_added_to_that_of_the_scenario() -> None:
    effects = [LaneService("a", 1.0, 2.0), LaneService("b", 5.0, 6.0), LaneService("b", 3.0, 0.0)]
    fitted = FittedService(["a", "c"], np.array([[0.5, 0.25], [4.0, 1.0]]))
    expected = {"a": (1.5, 2.25), "b": (3.0, 0.0), "c": (4.0, 1.0)}
    assert service_of(effects, [fitted]) == expected


def test_lanes_that_share_a_signal_have_the_red_of_the_slower_one() -> None:
    network = NETWORKS["single-v1"]
    (item,) = network.intersections
    fast = item.links[0]
    slow = next(link for link in item.links if link.from_lane != fast.from_lane)
    links = tuple(replace(link, index=0) for link in (fast, slow, fast))
    shared = replace(network, intersections=(replace(item, links=links),))
    red = withheld(shared, {slow.from_lane: (3.0, 2.0), fast.from_lane: (1.0, 0.5)})[item.id]
    assert (red.begin_s[0], red.each_s[0]) == (3.0, 2.0)


def test_every_lane_may_have_its_own_service_and_the_last_one_counts() -> None:
    scenario = ugat_marl.effects.load_scenario("single-v1")
    texts = ("northA_A1_1,4,0", "southA_A1_1,2,1", "northA_A1_1,1,0")
    domain = "+".join(f"lane_service={text}" for text in texts)
    changed = ugat_marl.effects.scenario_in_domain(scenario, domain)
    assert {x["lane"]: x["begin_s"] for x in changed.settings.effects} == {
        "northA_A1_1": 1.0,
        "southA_A1_1": 2.0,
    }
    with pytest.raises(UnknownNameError, match="norhtA_A1_1"):
        ugat_marl.effects.scenario_in_domain(scenario, "lane_service=norhtA_A1_1,4,0")
