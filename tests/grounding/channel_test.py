"""The command channel on logs of a signal that was written by hand, with planted faults."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

import ugat_marl
from ugat_marl.data import AgentLayout, Provenance, TransitionLog, TransitionRecorder
from ugat_marl.grounding.channel import (
    ChannelConfig,
    CommandChannel,
    _Course,
    _draws,
    fit_channel,
)
from ugat_marl.grounding.channel import obeyed as obeyed_in
from ugat_marl.scenarios import SignalState, SignalTiming

PHASES = 4
AGENTS = ("a_0", "b_0")
LAYOUTS = {agent: AgentLayout(1, PHASES) for agent in AGENTS}
TIMING = SignalTiming(yellow_s=3.0, all_red_s=2.0, min_green_s=5.0)
INTERVAL_S = 10.0

Mask = Callable[[int, int], Sequence[int]]
"""Permitted phases, from the running phase and its age in decisions."""


def anything(_running: int, _age: int) -> Sequence[int]:
    return range(PHASES)


def held(running: int, age: int) -> Sequence[int]:
    return [running] if age < 2 else range(PHASES)


def ended(running: int, age: int) -> Sequence[int]:
    return [phase for phase in range(PHASES) if phase != running or age < 4]


def ended_young(running: int, age: int) -> Sequence[int]:
    return [phase for phase in range(PHASES) if phase != running or age < 3]


def obeyed(command: int | None, running: int, allowed: Sequence[int]) -> int:
    if command is not None and command in allowed:
        return command
    if running in allowed:
        return running
    return next((phase for phase in sorted(allowed) if phase > running), min(allowed))


def log_of(
    lag: int | dict[str, int] = 0,
    lost: float = 0.0,
    late: float = 0.0,
    mask: Mask = anything,
    told: bool = True,
    keeps: bool = True,
    rows: dict[str, int] | None = None,
    seed: int = 0,
    hold: int = 1,
    begun: int = 1,
) -> TransitionLog:
    """Return a log of random commands that a street with these faults executed.

    A share of `lost` commands never arrives, and a share of `late` ones a decision after the
    others. A command is given for `hold` decisions. `begun` is the age of the first green, in
    decisions. `told` logs masks, and `keeps` gives permitted commands only, where they are logged.
    """
    lags = lag if isinstance(lag, dict) else dict.fromkeys(AGENTS, lag)
    generator = np.random.default_rng(seed)
    recorder = TransitionRecorder(
        Provenance("by hand", "", "street", (), INTERVAL_S, "count", LAYOUTS)
    )
    running, age = dict.fromkeys(AGENTS, 0), dict.fromkeys(AGENTS, begun)
    given: dict[str, list[int]] = {agent: [] for agent in AGENTS}
    for step in range(max((rows or {"": 360}).values())):
        seen = {a: np.array([0.0, *np.eye(PHASES)[running[a]]]) for a in AGENTS}
        masks = {a: np.isin(np.arange(PHASES), mask(running[a], age[a])) for a in AGENTS}
        asked: dict[str, int] = {}
        executed: dict[str, int] = {}
        for agent in AGENTS:
            choices = np.flatnonzero(masks[agent]) if told and keeps else np.arange(PHASES)
            holds = step % hold > 0 and given[agent][-1] in choices
            asked[agent] = given[agent][-1] if holds else int(generator.choice(choices))
            given[agent].append(asked[agent])
            fate = generator.random()
            behind = lags[agent] + int(lost <= fate < lost + late)
            arrives = given[agent][-1 - behind] if len(given[agent]) > behind else None
            if fate < lost:
                arrives = None
            executed[agent] = obeyed(arrives, running[agent], mask(running[agent], age[agent]))
        then = {a: np.array([0.0, *np.eye(PHASES)[executed[a]]]) for a in AGENTS}
        rewards = dict.fromkeys(AGENTS, 0.0)
        shown = {a: masks[a].astype(np.int8) for a in AGENTS} if told else None
        recorder.record(0, step, seen, asked, executed, rewards, then, masks=shown)
        for agent in AGENTS:
            age[agent] = 1 if executed[agent] != running[agent] else age[agent] + 1
            running[agent] = executed[agent]
    return recorder.log()


def permitted(channel: CommandChannel, state: SignalState, timing: SignalTiming) -> list[int]:
    """Return the phases that the fitted actuator permits."""
    actuator = channel.actuator(None, timing, INTERVAL_S)  # type: ignore[arg-type]
    assert actuator is not None
    mask = np.ones(PHASES, dtype=np.int8)
    actuator.restrict(mask, 0, state)
    return np.flatnonzero(mask).tolist()


def after_one_step(channel: CommandChannel, phase: int, age: int) -> list[int]:
    """Return the phases that the fitted actuator permits to a green of this age."""
    one, other = (  # a clearance more or less would be another age
        permitted(
            channel,
            SignalState(phase, phase, age * INTERVAL_S - TIMING.clearance_s - early_s),
            TIMING,
        )
        for early_s in (0.0, 1.0)
    )
    assert one == other
    return one


def test_an_obedient_street_has_no_channel() -> None:
    channel = fit_channel(log_of())
    assert not channel.changes
    assert channel.memory == 0
    assert channel.actuator(None, TIMING, INTERVAL_S) is None  # type: ignore[arg-type]


@pytest.mark.parametrize("told", [True, False])
def test_a_delay_of_two_decisions_with_lost_commands_is_recovered(told: bool) -> None:
    channel = fit_channel(log_of(lag=2, lost=0.2, told=told))
    assert channel.lag == 2
    assert channel.lost == pytest.approx(0.2, abs=0.05)
    assert channel.network[2] == pytest.approx(0.8, abs=0.05)
    assert channel.memory == 2
    assert "2 decisions late" in channel.describe()


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize("punctual", AGENTS)
def test_a_light_with_late_commands_tells_nothing_of_a_punctual_one(
    punctual: str, told: bool
) -> None:
    lags = {agent: 0 if agent == punctual else 2 for agent in AGENTS}
    channel = fit_channel(log_of(lag=lags, told=told, hold=3))
    for agent, weights, table in zip(AGENTS, channel.weights, channel.tables, strict=True):
        assert weights[lags[agent]] > 0.8, agent
        assert table[1:].all(), agent


def test_masks_of_each_light_are_read_with_its_own_delay() -> None:
    lags = {"a_0": 0, "b_0": 2}
    following = fit_channel(
        log_of(lag=lags, mask=lambda running, _: (running, (running + 1) % PHASES), hold=2)
    )
    wanted = np.eye(PHASES, dtype=bool) | np.roll(np.eye(PHASES, dtype=bool), 1, axis=1)
    assert np.array_equal(following.tables[0][-1], wanted)


def test_an_order_of_phases_is_read_off_the_masks() -> None:
    channel = fit_channel(log_of(mask=lambda running, _: (running, (running + 1) % PHASES)))
    assert channel.network[0] == 1.0
    assert after_one_step(channel, 1, age=1) == [1, 2]
    assert after_one_step(channel, 3, age=2) == [0, 3]


def test_an_order_of_phases_is_read_off_refused_commands_without_masks() -> None:
    def order(running: int, _age: int) -> Sequence[int]:
        return running, (running + 1) % PHASES

    channel = fit_channel(log_of(mask=order, told=False, lost=0.1, rows={"": 600}))
    assert after_one_step(channel, 1, age=1) == [1, 2]
    assert channel.lost == pytest.approx(0.1, abs=0.04)


def test_shortest_and_longest_greens_are_entries_of_the_table() -> None:
    def limits(running: int, age: int) -> Sequence[int]:
        others = [phase for phase in range(PHASES) if phase != running]
        if age < 2:
            return [running]
        return others if age >= 4 else [running, *others]

    channel = fit_channel(log_of(mask=limits, rows={"": 900}))
    assert after_one_step(channel, 2, age=1) == [2]
    assert after_one_step(channel, 2, age=3) == [0, 1, 2, 3]
    assert after_one_step(channel, 2, age=4) == [0, 1, 3]
    assert after_one_step(channel, 2, age=9) == [0, 1, 3]  # not seen: as the oldest that was


def test_a_longest_green_is_read_off_refused_commands_at_all_later_ages() -> None:
    """No green is older than the longest one, so that nothing is refused at such an age."""
    channel = fit_channel(log_of(mask=ended, told=False, rows={"": 4000}))
    assert after_one_step(channel, 2, age=3) == [0, 1, 2, 3]
    for age in (4, 5, 9):
        assert after_one_step(channel, 2, age) == [0, 1, 3]


def test_the_age_of_a_green_counts_from_the_beginning_of_its_clearance() -> None:
    channel = fit_channel(log_of(mask=held))
    slow = SignalTiming(yellow_s=9.0, all_red_s=3.0, min_green_s=5.0)
    assert permitted(channel, SignalState(2, 1, 10.0), slow) == [2]
    assert permitted(channel, SignalState(2, 2, 8.0), slow) == [0, 1, 2, 3]
    # it began between two decisions, and this is the third one in which it runs
    third = SignalState(2, 2, 2.5 * INTERVAL_S - TIMING.clearance_s)
    assert permitted(fit_channel(log_of(mask=ended_young)), third, TIMING) == [0, 1, 3]


def test_a_green_from_before_the_episode_may_be_of_any_age() -> None:
    """All commands are obeyed, also the first one, which ends a green of unknown age."""
    log = log_of(mask=held, begun=5)
    course = _Course.of(log.transitions("a_0"), LAYOUTS["a_0"], ChannelConfig(), held=0.0)
    assert course.executed[0] != course.running[0]
    table = course.table_of_masks(0)
    assert np.flatnonzero(table[1, 0]).tolist() == [0], "a young green is held"
    kept = replace(course, mask=None)  # so that the table counts
    assert np.array_equal(
        obeyed_in(course.asked[0], kept.running, kept.permitted(table, 0)), course.executed
    )


def test_no_command_arrives_from_another_episode() -> None:
    """Of commands 0, 1, 2, ... the ones before the second episode never arrive in it."""
    layouts = {"a_0": AgentLayout(1, PHASES)}
    recorder = TransitionRecorder(
        Provenance("by hand", "", "street", (), INTERVAL_S, "count", layouts)
    )
    for row in range(6):
        seen = {"a_0": np.array([0.0, *np.eye(PHASES)[0]])}
        ran, asked = {"a_0": 0}, {"a_0": row % PHASES}
        recorder.record(row // 3, row % 3, seen, asked, ran, {"a_0": 0.0}, seen)
    log = recorder.log()
    course = _Course.of(log.transitions("a_0"), layouts["a_0"], ChannelConfig(), held=0.0)
    assert course.asked[:3].tolist() == [
        [0, 1, 2, 3, 0, 1],
        [-1, 0, 1, -1, 3, 0],
        [-1, -1, 0, -1, -1, 3],
    ]
    assert course.left.tolist() == [2, 1, 0, 2, 1, 0]
    assert course.age.tolist() == [0] * 6, "they began before the episode"


def test_greens_that_the_simulation_holds_itself_are_not_forbidden() -> None:
    log = log_of(mask=held)
    assert fit_channel(log).forbids
    assert not fit_channel(log, held_s=2 * INTERVAL_S).changes

    longer = fit_channel(log, held_s=INTERVAL_S)  # the street holds greens longer than that
    assert after_one_step(longer, 2, age=1) == [2]

    def cyclic_and_held(running: int, age: int) -> Sequence[int]:
        return [running] if age < 2 else [running, (running + 1) % PHASES]

    assert fit_channel(log_of(mask=cyclic_and_held), held_s=2 * INTERVAL_S).forbids


@pytest.mark.parametrize("told", [True, False])
def test_commands_refused_in_the_simulations_own_shortest_green_are_neither_late_nor_lost(
    told: bool,
) -> None:
    log = log_of(mask=held, told=told, keeps=False, hold=2)
    assert not fit_channel(log, held_s=2 * INTERVAL_S).changes


@pytest.mark.parametrize("keeps", [True, False])
def test_a_longest_green_of_many_decisions_is_found(keeps: bool) -> None:
    def limit(running: int, age: int) -> Sequence[int]:
        return [phase for phase in range(PHASES) if phase != running or age < 20]

    channel = fit_channel(log_of(mask=limit, keeps=keeps, hold=30, rows={"": 2000}))
    assert channel.network[0] == 1.0
    assert after_one_step(channel, 2, age=19) == [0, 1, 2, 3]
    for age in (20, 21, 50):
        assert after_one_step(channel, 2, age) == [0, 1, 3]


def test_masks_count_where_the_table_is_too_coarse() -> None:
    """A longest green in seconds ends at one of two ages if greens begin between decisions."""
    endings = np.random.default_rng(3).integers(4, 6, 10_000).tolist()

    def limit(running: int, age: int) -> Sequence[int]:
        return [phase for phase in range(PHASES) if phase != running or age < endings[0]]

    def at_random(running: int, age: int) -> Sequence[int]:
        if age == 1:
            endings.pop(0)
        return limit(running, age)

    log = log_of(mask=at_random, keeps=False, hold=7, rows={"": 1000})
    assert fit_channel(log).network[0] == 1.0


def test_the_actuator_repeats_the_street() -> None:
    channel = fit_channel(log_of(lag=2, lost=0.2))
    actuator = channel.actuator(None, TIMING, INTERVAL_S)  # type: ignore[arg-type]
    assert actuator is not None
    arrived: list[tuple[int, int | None]] = []
    actuator.reset(7)
    for step in range(2000):
        command = step % PHASES
        arrived.append((command, actuator.send([command, command])[0]))
    late = [arrival for _, arrival in arrived[2:]]
    lost = sum(arrival is None for arrival in late) / len(late)
    assert lost == pytest.approx(channel.drawn(7)[0, -1], abs=0.03)
    expected = [step % PHASES for step in range(len(late))]
    assert all(a is None or a == b for a, b in zip(late, expected, strict=True))
    assert list(actuator.under_way) == [[2, 2], [3, 3]]


def test_where_every_command_is_lost_a_policy_has_none_to_see() -> None:
    channel = fit_channel(log_of(lost=1.0, rows=dict.fromkeys(AGENTS, 200)))
    assert channel.lost > 0.95
    assert channel.memory == 1


def test_the_seed_of_an_episode_decides_what_is_lost() -> None:
    channel = fit_channel(log_of(lost=0.3))
    actuator = channel.actuator(None, TIMING, INTERVAL_S)  # type: ignore[arg-type]
    assert actuator is not None

    def play(seed: int) -> list[list[int | None]]:
        actuator.reset(seed)
        return [list(actuator.send([1, 1])) for _ in range(50)]

    assert play(1) == play(1)
    assert play(1) != play(2)


def test_weights_of_a_short_log_follow_the_network() -> None:
    """An intersection whose log says little takes the weights of the others, never zero."""
    telling = np.eye(3, dtype=bool)[:, np.repeat([1, 2], [240, 60])]  # late or lost, for certain
    drawn = _draws([telling, telling[:, :0]], pull=15.0)
    assert drawn.sum(-1) == pytest.approx(1.0)
    assert drawn.mean(0) == pytest.approx(np.array([[0.0, 0.8, 0.2]] * 2), abs=0.05)
    assert drawn[:, 1].std(0).max() > 1.5 * drawn[:, 0].std(0).max()


@pytest.mark.parametrize("agents", [1, 2])
def test_intervals_of_lost_commands_hold_the_truth_as_often_as_they_say(
    agents: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the 90 % intervals of short logs nine in ten hold the share, of one intersection too."""
    monkeypatch.setitem(globals(), "AGENTS", AGENTS[:agents])
    monkeypatch.setitem(globals(), "LAYOUTS", {a: LAYOUTS[a] for a in AGENTS})
    held: list[bool] = []
    for seed in range(60):
        found = fit_channel(log_of(lost=0.2, rows=dict.fromkeys(AGENTS, 60), seed=seed))
        numbers = found.as_dict(INTERVAL_S)
        low, high = (numbers.get(f"channel/missing_{end}/a_0", 0.0) for end in ("low", "high"))
        held.append(low <= 0.2 <= high)
    assert 50 <= sum(held) <= 59


@pytest.mark.parametrize("hold", [1, 3])
def test_intervals_allow_for_commands_that_may_be_late_or_lost(
    hold: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Most decisions of a street with both are explained by either."""
    monkeypatch.setitem(globals(), "AGENTS", AGENTS[:1])
    monkeypatch.setitem(globals(), "LAYOUTS", {"a_0": LAYOUTS["a_0"]})
    held = 0
    for seed in range(30):
        log = log_of(lost=0.15, late=0.15, rows={"": 180}, hold=hold, seed=seed)
        channel = fit_channel(log)
        low, high = np.quantile([channel.drawn(n)[0, -1] for n in range(400)], (0.05, 0.95))
        held += low <= 0.15 <= high
    assert held >= 24


def test_draws_of_decisions_that_one_kind_explains_are_those_of_dirichlet() -> None:
    counts = np.array([140, 30, 0, 30])
    drawn = _draws([np.eye(4, dtype=bool)[:, np.repeat(np.arange(4), counts)]], pull=1.0)[:, 0]
    wanted = np.random.default_rng(0).dirichlet(counts + 1e-3, 20_000)
    assert drawn.mean(0) == pytest.approx(wanted.mean(0), abs=0.01)
    assert drawn.std(0) == pytest.approx(wanted.std(0), abs=0.005)


def test_the_largest_weight_stays_however_large_a_weight_must_be() -> None:
    channel = fit_channel(log_of(lag=2, lost=0.4), ChannelConfig(least_share=0.9))
    assert channel.network[2] == 1.0
    assert channel.lag == 2


def test_masks_are_those_of_the_known_lag_from_the_first_decision_on() -> None:
    channel = fit_channel(log_of(lag=2, lost=0.2))
    actuator = channel.actuator(None, TIMING, INTERVAL_S)  # type: ignore[arg-type]
    assert actuator is not None
    actuator.reset(3)
    nothing = [None] * len(channel.agents)
    assert list(actuator.under_way) == [nothing, nothing]
    actuator.send([1] * len(channel.agents))
    assert list(actuator.under_way) == [nothing, [1] * len(channel.agents)]


def test_a_channel_survives_its_checkpoint() -> None:
    channel = fit_channel(log_of(lag=1, lost=0.1))
    again = CommandChannel.from_state(channel.state_dict())
    assert np.array_equal(again.network, channel.network)
    assert all(np.array_equal(a, b) for a, b in zip(again.tables, channel.tables, strict=True))


def test_a_command_may_be_later_than_by_default_if_the_method_is_told_so() -> None:
    log = log_of(lag=8)
    assert fit_channel(log).network.max() < 0.5  # beyond the longest lag all explain a little
    assert fit_channel(log, ChannelConfig(most_lag=8)).lag == 8


def test_masks_say_what_is_obeyed_though_commands_are_late_twice() -> None:
    """By the simulation's own delay, and by a fitted channel behind it."""
    channel = CommandChannel(
        ("signal_0",),
        np.array([0.0, 1.0, 0.0]),
        np.array([[0.0, 1.0, 0.0]]),
        np.array([[[0.0, 1.0, 0.0]]]),
        (np.ones((3, 8, 8), dtype=bool),),
    )
    env = ugat_marl.parallel_env(
        "single-v1", "execution_delay=10+phase_order=cyclic", fitted=(channel,), duration_s=600
    )
    _, infos = env.reset(seed=1)
    draws = np.random.default_rng(0)
    asked, masks, executed = [], [], [infos["signal_0"]["executed_action"]]
    while env.agents:
        masks.append(infos["signal_0"]["action_mask"].copy())
        permitted = np.flatnonzero(masks[-1]).tolist()
        asked.append(int(draws.choice(permitted if draws.random() < 0.5 else 8)))
        *_, infos = env.step({"signal_0": asked[-1]})
        executed.append(infos["signal_0"]["executed_action"])
    env.close()
    obeyed = [then == now for now, then in zip(asked, executed[3:], strict=False)]
    allowed = [bool(mask[now]) for mask, now in zip(masks, asked, strict=True)]
    assert obeyed == allowed[: len(obeyed)]
