"""Rules against queues and pressures counted by hand."""

from __future__ import annotations

import dataclasses
import pickle
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ugat_marl import parallel_env
from ugat_marl.envs import frame_stack, pad_spaces
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.policies import (
    RULE_NAMES,
    RULES,
    STANDARD_RULES,
    ControlledNetwork,
    FixedTime,
    Policy,
    format_rule,
    make_rule,
    parse_rule,
    roll_out,
)
from ugat_marl.policies.rules.approaches import covering_phases
from ugat_marl.policies.rules.catalogue import example_of
from ugat_marl.policies.rules.open_loop import ProgrammeControl, Random
from ugat_marl.policies.rules.phase_scores import LargestQueue, MaxPressure
from ugat_marl.scenarios import Intersection, Lane, Link, Network, SignalTiming

# Two approaches. Lane n_0 goes straight (to s_0) or right (to w_0), lane n_1 left (to e_0 or e_1);
# lane w_0 goes straight (to e_0). The right turn is green, yielding, in the second phase as well.
LINKS = (
    Link(0, "n_0", "s_0", "s"),
    Link(1, "n_0", "w_0", "r"),
    Link(2, "n_1", "e_0", "l"),
    Link(2, "n_1", "e_1", "l"),
    Link(3, "w_0", "e_0", "s"),
)
INCOMING = ("n_0", "n_1", "w_0")
OUTGOING = ("s_0", "w_0", "e_0", "e_1")
PHASES = ("GGrr", "rgGr", "rrrG")
CAPACITY = {"n_0": 40.0, "n_1": 20.0, "w_0": 10.0, "s_0": 40.0, "e_0": 10.0, "e_1": 20.0}
FREE_FLOW_S = dict.fromkeys(CAPACITY, 20.0)
AGENT = "signal_0"


def crossing(phases: tuple[str, ...] = PHASES, links: tuple[Link, ...] = LINKS) -> Intersection:
    return Intersection("x", INCOMING, OUTGOING, links, phases, (), (), (0.0, 0.0))


def streets(interval_s: float = 10.0) -> ControlledNetwork:
    return ControlledNetwork({AGENT: crossing()}, CAPACITY, FREE_FLOW_S, interval_s, 5.0)


def env(**changes: Any) -> Any:
    lanes = {name: Lane(name, name[:-2], 7.5 * c, 13.9, ()) for name, c in CAPACITY.items()}
    base = SimpleNamespace(
        network=Network(lanes, (crossing(),), ()),
        intersection_of={AGENT: "x"},
        possible_agents=[AGENT],
        decision_interval_s=10.0,
        scenario=SimpleNamespace(timing=SignalTiming(3.0, 2.0, 5.0)),
        **changes,
    )
    base.unwrapped = base
    return base


def observe(
    halting: dict[str, int] | None = None, vehicles: dict[str, int] | None = None, shown: int = 0
) -> dict[str, np.ndarray[Any, np.dtype[np.float32]]]:
    """The observation `movements`, made from counts of vehicles."""
    halting, vehicles = halting or {}, vehicles or {}
    features = [halting.get(lane, 0) / CAPACITY[lane] for lane in INCOMING]
    features += [vehicles.get(lane, 0) / CAPACITY[lane] for lane in (*INCOMING, *OUTGOING)]
    return {AGENT: np.array([*features, *np.eye(len(PHASES))[shown]], dtype=np.float32)}


def allow(*mask: int) -> dict[str, dict[str, Any]]:
    return {AGENT: {"action_mask": np.array(mask, dtype=np.int8)}}


ALL = allow(1, 1, 1)


def test_largest_queue_counts_the_halting_vehicles_of_served_lanes_once():
    rule = LargestQueue(streets(), 10)
    seen = observe({"n_0": 3, "n_1": 2, "w_0": 4}, vehicles={"w_0": 9})
    # phase 0 serves n_0 by two links, phase 1 serves n_0 (right turn) and n_1, phase 2 serves w_0
    assert rule.scores(AGENT, seen[AGENT]) == pytest.approx([3, 5, 4])
    assert rule.act(seen, ALL) == {AGENT: 1}
    assert rule.act(observe({"w_0": 6}), ALL) == {AGENT: 2}


def test_max_pressure_is_upstream_minus_downstream():
    rule = MaxPressure(streets(), 10)
    seen = observe(vehicles={"n_0": 8, "n_1": 6, "w_0": 5, "s_0": 4, "e_0": 2, "e_1": 4})
    expected = [
        8 - (4 + 5) / 2,  # n_0 into s_0 and w_0
        (8 - 5) + (6 - (2 + 4) / 2),  # n_0 into w_0, n_1 into e_0 and e_1
        5 - 2,  # w_0 into e_0
    ]
    assert rule.scores(AGENT, seen[AGENT]) == pytest.approx(expected)
    assert rule.act(seen, ALL) == {AGENT: 1}
    jammed = observe(vehicles={"n_0": 8, "n_1": 6, "w_0": 5, "s_0": 4, "e_0": 2, "e_1": 20})
    assert rule.act(jammed, ALL) == {AGENT: 0}  # 3.5 against 3 + (6 - 11) and 3


@pytest.mark.parametrize("rule", [LargestQueue, MaxPressure])
@pytest.mark.parametrize(("hold_s", "decisions"), [(10, 1), (20, 2), (25, 3), (30, 3)])
def test_a_phase_is_held_and_then_reconsidered(rule: Any, hold_s: float, decisions: int):
    controller = rule(streets(), hold_s)
    north, west = ({lane: 5} for lane in ("n_0", "w_0"))
    assert controller.act(observe(north, north), ALL) == {AGENT: 0}
    shown = [controller.act(observe(west, west), ALL)[AGENT] for _ in range(decisions)]
    assert shown == [0] * (decisions - 1) + [2]
    controller.reset(0)
    assert controller.act(observe(north, north), ALL) == {AGENT: 0}  # nothing is held any more


def test_a_phase_that_stays_best_goes_on_and_ties_do_not_switch():
    rule = LargestQueue(streets(), 20)
    for _ in range(5):
        assert rule.act(observe({"w_0": 5}), ALL) == {AGENT: 2}
    assert rule.act(observe({"w_0": 3, "n_0": 3}), ALL) == {AGENT: 2}
    assert rule.act(observe({"n_0": 3}), ALL) == {AGENT: 0}  # held long enough: leaves at once
    assert rule.act(observe({"w_0": 9}), ALL) == {AGENT: 0}


@pytest.mark.parametrize(
    "spec", [*(name for name in RULE_NAMES if name != "programme"), "fixed-time:10"]
)
def test_masked_phases_are_not_chosen(spec: str):
    controller = make_rule(spec, env())
    controller.reset(1)
    for mask in ((0, 1, 1), (1, 0, 0), (0, 0, 1), (0, 1, 0)):
        seen = observe({"n_0": 9, "w_0": 3}, {"n_0": 9, "w_0": 3})
        assert mask[controller.act(seen, allow(*mask))[AGENT]] == 1


def test_rules_refuse_another_observation():
    short = {AGENT: np.zeros(6, np.float32)}
    with pytest.raises(OptionError, match="movements"):
        LargestQueue(streets()).act(short, ALL)


def test_fixed_time_gives_each_phase_of_the_cover_its_turn():
    controller = FixedTime(streets(), 20)
    turns = [controller.act({}, ALL)[AGENT] for _ in range(8)]
    assert turns == [0, 0, 1, 1, 2, 2, 0, 0]
    controller.reset(0)
    assert controller.act({}, ALL) == {AGENT: 0}


def test_cover_is_smallest_and_overlaps_least():
    four = tuple(Link(i, "n_0", "s_0", "s") for i in range(4))
    assert covering_phases(crossing(("Grrr", "rGGr", "GGrr", "rrGG"), four)) == (2, 3)
    # {0, 1} and {1, 2} both cover; the second has no link green twice
    assert covering_phases(crossing(("GGGr", "rrGG", "GGrr"), four)) == (1, 2)
    # link 3 is never green: nobody can serve it
    assert covering_phases(crossing(("GGrr", "rrGr"), four)) == (0, 1)


def test_cover_of_many_phases_is_a_cover():
    links = tuple(Link(i, "n_0", "s_0", "s") for i in range(16))
    states = tuple(
        "".join("G" if j in (i, (i + 1) % 16) else "r" for j in range(16)) for i in range(16)
    )
    chosen = covering_phases(crossing(states, links))
    assert len(chosen) == 8
    assert all(any(states[i][j] == "G" for i in chosen) for j in range(16))


def test_random_depends_on_the_seed_only_and_is_uniform_over_the_allowed():
    controller = Random(streets())
    runs: list[list[int]] = []
    for seed in (3, 3, 4):
        controller.reset(seed)
        runs.append([controller.act({}, allow(1, 0, 1))[AGENT] for _ in range(2000)])
    assert runs[0] == runs[1] != runs[2]
    assert np.bincount(runs[0], minlength=3) / 2000 == pytest.approx([0.5, 0, 0.5], abs=0.05)


def test_environment_options_say_what_each_controller_needs():
    options = {name: dict(make_rule(name, env()).env_options) for name in RULE_NAMES}
    movements = {"observation": "movements"}
    assert options == {
        "actuated": movements,
        "delay-actuated": {"observation": "waiting"},
        "fixed-time": {},
        "green-wave": {},
        "largest-queue": movements,
        "longest-waiting": {"observation": "waiting"},
        "max-pressure": movements,
        "max-pressure-loss": movements,
        "programme": {"signals": "programme"},
        "random": {},
        "sotl": movements,
        "webster": movements,
    }
    assert make_rule("programme", env()).act(observe(), ALL) == {AGENT: 0}


@pytest.mark.parametrize("spec", [*STANDARD_RULES, *RULE_NAMES])
def test_every_controller_is_a_policy_that_can_be_sent_to_a_worker(spec: str):
    controller = make_rule(spec, env())
    assert isinstance(controller, Policy)
    copy = pickle.loads(pickle.dumps(controller))  # noqa: S301
    for each in (controller, copy):
        each.reset(5)
    seen = observe({"n_1": 4}, {"n_1": 4})
    assert copy.act(seen, ALL) == controller.act(seen, ALL)


def test_spellings():
    made = make_rule("largest-queue:37.5", env())
    assert isinstance(made, LargestQueue)
    assert made.hold_s == 37.5
    assert parse_rule("fixed-time") == ("fixed-time", (30.0,))
    assert parse_rule("max-pressure:10") == ("max-pressure", (10.0,))
    assert parse_rule("actuated:60") == ("actuated", (60.0, 3.0))
    assert parse_rule("actuated:60:2") == ("actuated", (60.0, 2.0))
    assert parse_rule("programme") == ("programme", ())
    assert isinstance(make_rule("programme", env()), ProgrammeControl)
    with pytest.raises(UnknownNameError, match="Did you mean 'largest-queue'"):
        make_rule("larges-queue:30", env())
    for spec in ("fixed-time:soon", "max-pressure:0", "largest-queue:", "largest-queue:nan"):
        with pytest.raises(OptionError, match="seconds above 0"):
            parse_rule(spec)
    with pytest.raises(OptionError, match="headway that ends a green.*'actuated:40:3'"):
        parse_rule("actuated:40:-1")
    for spec in ("webster:much", "webster:90"):  # 90 is meant as a cycle
        with pytest.raises(OptionError, match="hour and lane of at least 300.*'webster:1800'"):
            parse_rule(spec)
    with pytest.raises(OptionError, match="random takes no number; write 'random'"):
        parse_rule("random:3")
    with pytest.raises(
        OptionError, match="takes time of a phase in seconds; write 'fixed-time:30'"
    ):
        parse_rule("fixed-time:30:4")
    with pytest.raises(OptionError, match="held -1 s"):
        LargestQueue(streets(), -1)


@pytest.mark.parametrize("name", RULE_NAMES)
def test_the_written_out_defaults_and_all_that_tuning_tries_are_spellings(name: str):
    rule = RULES[name]
    assert parse_rule(example_of(name)) == parse_rule(name)
    for place, parameter in enumerate(rule.parameters):
        for value in parameter.choices:
            values = [p.default for p in rule.parameters]
            values[place] = value
            assert parse_rule(format_rule(name, values)) == (name, tuple(values))


def test_several_intersections_are_held_apart():
    other = dataclasses.replace(crossing(), id="y")
    two = ControlledNetwork(
        {AGENT: crossing(), "signal_1": other}, CAPACITY, FREE_FLOW_S, 10.0, 5.0
    )
    rule = LargestQueue(two, 20)

    def both(first: dict[str, int], second: dict[str, int]) -> Any:
        return {AGENT: observe(first)[AGENT], "signal_1": observe(second)[AGENT]}

    assert rule.act(both({"n_0": 1}, {"w_0": 1}), {}) == {AGENT: 0, "signal_1": 2}
    assert rule.act(both({"w_0": 1}, {"n_0": 1}), {}) == {AGENT: 0, "signal_1": 2}
    assert rule.act(both({"w_0": 1}, {"n_0": 1}), {}) == {AGENT: 2, "signal_1": 0}


@pytest.mark.parametrize("spec", ["largest-queue", "max-pressure", "max-pressure-loss", "sotl"])
def test_rules_act_behind_padded_spaces(spec: str) -> None:
    """As without them: the phases of padding are none of the light's."""
    played: list[float] = []
    for wrap in (lambda env: env, pad_spaces):
        env = wrap(parallel_env("mixed-v1", duration_s=60, observation="movements"))
        roll_out(env, make_rule(spec, env), 1)
        played.append(env.scores().att_s)
        env.close()
    assert played[0] == played[1]


def test_a_rule_refuses_stacked_observations() -> None:
    """It would read the oldest one; a rule that reads none may have them."""
    env = parallel_env("single-v1", duration_s=60, observation="movements")
    make_rule("max-pressure", frame_stack(env, 1))
    for wrapped in (frame_stack(env, 3), pad_spaces(frame_stack(env, 3))):
        with pytest.raises(OptionError, match="frame_stack shows 3; give the rule the env"):
            make_rule("max-pressure", wrapped)
        make_rule("fixed-time", wrapped)
    env.close()
