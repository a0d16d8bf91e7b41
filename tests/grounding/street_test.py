"""A fitted street in SUMO: a planted channel, its training, interruption, and controls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import polars as pl
import pytest
from numpy.typing import NDArray

from tests.interrupts import KillAt
from tests.runs import FITTED, SMALL, numbers, play_nothing, weights
from ugat_marl.data import TransitionLog, write_checkpoint
from ugat_marl.effects import DetectionZone, load_scenario, scenario_in_domain
from ugat_marl.envs import parallel_env
from ugat_marl.errors import CheckpointError, LogError, OptionError, UnknownNameError
from ugat_marl.experiments import transfer
from ugat_marl.experiments.training import simulated_worlds
from ugat_marl.grounding import (
    PARTS,
    FittedStreet,
    LaneView,
    NegativeControl,
    Simulation,
    StreetConfig,
    StreetFit,
    StreetWorld,
    UgatConfig,
    fit_channel,
    fit_street,
    require_histories,
    street_env,
    street_prior,
    street_training,
)
from ugat_marl.grounding import street as street_module
from ugat_marl.grounding.channel import ChannelConfig, CommandChannel
from ugat_marl.grounding.eyes import Eyes, EyesConfig, fit_eyes
from ugat_marl.grounding.posterior import Posterior, WorldValues
from ugat_marl.grounding.residual import ResidualConfig
from ugat_marl.grounding.state import RunState
from ugat_marl.grounding.street import LEARNT
from ugat_marl.grounding.street_training import StreetTraining
from ugat_marl.grounding.summaries import NAMES, Summary
from ugat_marl.grounding.worlds import RecordedCommands
from ugat_marl.parallel import LocalProcesses, Stop
from ugat_marl.policies import (
    DQN,
    DQNConfig,
    EpsilonGreedy,
    NamedRule,
    Policy,
    make_rule,
    observer_of,
    roll_out,
    rule_in,
)
from ugat_marl.progress import Silent
from ugat_marl.simulation import kept_warm

SCENARIO = load_scenario("single-v1")
LATE = "execution_delay=20+lost_commands=0.2"
QUICK = StreetConfig(simulations=20, further=4, simulated_s=100.0, rule_budget=0, rival="none")


def recorded(domain: str, seconds: float = 900.0, seed: int = 0) -> TransitionLog:
    env = parallel_env(SCENARIO, domain, duration_s=seconds, crossings=True)
    try:
        rule = EpsilonGreedy(make_rule("fixed-time:20", env), 0.3)
        log = roll_out(env, rule, seed, record=observer_of(env)).log
    finally:
        env.close()
    assert log is not None
    return log


def simulation(seconds: float = 100.0) -> Simulation:
    return Simulation(SCENARIO, {"duration_s": seconds}, epsilon=0.3, workers=1)


@pytest.fixture(scope="module")
def street() -> FittedStreet:
    """The street of a log with late and lost commands."""
    env = parallel_env(SCENARIO)
    prior = street_prior(env, QUICK)
    view = LaneView.of(env.network, env.options.observation)
    rule = make_rule("fixed-time:20", env)
    env.close()
    with kept_warm():
        return fit_street(recorded(LATE), simulation(), rule, prior, view, QUICK, seed=0)[0]


def test_the_planted_channel_of_a_simulated_street_is_found(street: FittedStreet) -> None:
    assert street.channel is not None
    assert street.channel.lag == 2
    assert street.channel.lost == pytest.approx(0.2, abs=0.1)
    assert street.commands == 2


def test_the_fitted_simulation_executes_as_the_street_does(street: FittedStreet) -> None:
    """A log of the fitted simulation has the channel that its own fit says."""
    env = street_env(street, simulation(seconds=900.0), street.commands)
    try:
        rule = EpsilonGreedy(make_rule("fixed-time:20", env.env), 0.3)
        logs = [roll_out(env, rule, seed, record=observer_of(env)).log for seed in (1, 2, 3)]
    finally:
        env.close()
    again = [fit_channel(log) for log in logs if log is not None]
    assert [channel.lag for channel in again] == [2, 2, 2]
    # Each episode draws its own share.
    assert np.mean([channel.lost for channel in again]) == pytest.approx(0.2, abs=0.15)


def test_every_episode_draws_its_own_world_and_a_seed_repeats_it(street: FittedStreet) -> None:
    env = street_env(street, simulation(), street.commands)
    domains: list[str] = []
    try:
        for seed in (1, 1, 2):
            observations, _ = env.reset(seed=seed)
            domains.append(env.env.domain)
            assert env.observation_space("signal_0").contains(observations["signal_0"])
    finally:
        env.close()
    assert domains[0] == domains[1] != domains[2]


def test_a_street_survives_its_file_and_refuses_another_network(
    street: FittedStreet, tmp_path: Path
) -> None:
    street.save(tmp_path / "street.pt")
    env = parallel_env(SCENARIO)
    prior = street_prior(env, QUICK)
    env.close()
    again, _ = FittedStreet.load(tmp_path / "street.pt", prior)
    assert again.world(3).effects == street.world(3).effects
    lanes_of = {"signal_0": range(len(street.lanes))}
    assert again.as_dict(lanes_of) == street.as_dict(lanes_of)
    with pytest.raises(CheckpointError, match="other lanes"):
        FittedStreet.load(tmp_path / "street.pt", replace(prior, lanes=prior.lanes[:2]))
    write_checkpoint(tmp_path / "old.pt", "street", {"lanes": list(prior.lanes)})
    with pytest.raises(CheckpointError, match="another version"):
        FittedStreet.load(tmp_path / "old.pt", prior)
    with pytest.raises(CheckpointError, match="another library"):
        FittedStreet.load(tmp_path / "street.pt", replace(prior, library=prior.library[:2]))


def test_metrics_tell_intersections_apart_each_with_its_interval() -> None:
    # a: 1,000 commands of which 200 are lost and half of the others are two decisions late; b: ten
    weights = np.array([0.4, 0.0, 0.4, 0.2])
    generator = np.random.default_rng(0)
    draws = np.stack([generator.dirichlet(n * weights, 200) for n in (1000, 10)], axis=1)
    free = np.ones((3, 2, 2), dtype=bool)
    channel = CommandChannel(("a", "b"), weights, np.array([weights, weights]), draws, (free, free))
    eyes = Eyes(np.array([1.0, 0.5, 0.0, 0.0]), (0.0, 0.0), 0.0, 0.0, 0, 0.0)
    street = FittedStreet(("0", "1", "2", "3"), 10.0, channel, eyes)
    numbers = street.as_dict({"a": (0, 1), "b": (2, 3)})
    assert numbers["channel/late_s/a"] == pytest.approx(10.0, abs=0.5)
    assert numbers["channel/missing/a"] == pytest.approx(0.2, abs=0.01)
    assert numbers["channel/missing_low/a"] > 0.17
    assert numbers["channel/missing_high/a"] < 0.23
    # Ten decisions' worth of belief leaves b wide around the network's share.
    assert numbers["channel/missing_low/b"] < 0.1 < 0.3 < numbers["channel/missing_high/b"]
    assert [numbers[f"eyes/unseen{end}/a"] for end in ("_low", "_high")] == [1.0, 2.0]
    assert [numbers[f"eyes/unseen{end}/b"] for end in ("_low", "", "_high")] == [0.0] * 3

    obeyed = replace(channel, network=np.array([1.0, 0, 0, 0]))
    perfect = FittedStreet(street.lanes, 10.0, obeyed, replace(eyes, dead=np.zeros(4)))
    names = perfect.as_dict({"a": (0, 1), "b": (2, 3)})
    assert not [name for name in names if name.endswith(("/a", "/b"))]


def test_values_of_the_simulation_s_own_vehicles_change_nothing(
    crossing: Callable[..., Path],
) -> None:
    types = """<vType id="slow" accel="2.5" tau="5" decel="4.5"/>
        <vType id="old"><carFollowing-Krauss accel="1.5"/></vType>"""
    car = '<vehicle id="v" type="slow" route="north" depart="0"/>'
    for domain, mean in (("sim", 2.0), ("acceleration=0.7", 0.7)):
        env = parallel_env(crossing(vehicles=car, types=types), domain)
        prior = street_prior(env, QUICK)
        env.close()
        found = {item.name: item for item in prior.library}
        assert found["acceleration"].nominal == mean
        headway = found["headway"]  # of 5 and SUMO's 1 s; its range grows to hold the mean
        assert (headway.nominal, headway.high) == (3.0, 3.0)
        assert found["startup_delay"].nominal == 0.0
        nominal = WorldValues(np.array([x.nominal for x in prior.library]), np.zeros((2, 2)))
        assert prior.effects(prior.clipped(nominal)) == ()


@pytest.mark.parametrize(
    "part", ["channel", "eyes", "service", pytest.param("effects", marks=pytest.mark.slow)]
)
def test_each_part_can_be_fitted_alone(part: str) -> None:
    config = replace(QUICK, parts=(part,))
    env = parallel_env(SCENARIO)
    prior = street_prior(env, config)
    view = LaneView.of(env.network, "count")
    rule = make_rule("fixed-time:20", env)
    env.close()
    log = recorded(LATE, 300)
    street, _ = fit_street(log, simulation(), rule, prior, view, config, seed=0)
    fitted = {name for name in ("channel", "eyes", "posterior") if getattr(street, name)}
    assert fitted == {{"service": "posterior", "effects": "posterior"}.get(part, part)}
    if street.posterior is not None:
        effects, service_s = street.posterior.sample(20)
        assert bool(effects.size) == (part == "effects")
        assert bool(service_s.any()) == (part == "service")


@pytest.mark.slow
def test_the_last_worlds_of_a_fit_are_drawn_from_the_posterior_of_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = replace(QUICK, parts=("effects",), simulations=20, further=4)
    env = parallel_env(SCENARIO)
    prior, view = street_prior(env, config), LaneView.of(env.network, "count")
    rule = make_rule("fixed-time:20", env)
    env.close()
    fitted: list[int] = []
    fit, draw = Posterior.fit, Posterior.draw

    def counted(worlds: Any, simulated: Any, seen: Any) -> Posterior:
        fitted.append(len(simulated))
        return fit(worlds, simulated, seen)

    def marked(self: Posterior, seed: int, chance: float) -> WorldValues:
        assert chance == LEARNT  # worlds to learn from have most effects
        values = draw(self, seed, chance)
        return replace(values, effects=np.append(values.effects[:-1], 1.0123))

    monkeypatch.setattr(Posterior, "fit", counted)
    monkeypatch.setattr(Posterior, "draw", marked)
    history = None
    for _ in range(2):
        _, history = fit_street(
            recorded("sim", 40.0), simulation(), rule, prior, view, config, seed=0, history=history
        )
    assert history is not None
    aimed = [item.values.effects[-1] == 1.0123 for item in history.simulated]
    assert aimed == [False] * 12 + [True] * 8 + [False] * 2 + [True] * 2
    assert fitted == [12, 20, 24]


@pytest.mark.parametrize(
    ("recorded_s", "simulated_s", "compared_s"),
    [
        pytest.param(600.0, 400.0, 300.0, marks=pytest.mark.slow),
        (80.0, 200.0, 80.0),
        pytest.param(120.0, 80.0, 80.0, marks=pytest.mark.slow),
    ],
)
def test_a_street_is_compared_with_worlds_of_the_same_length(
    recorded_s: float, simulated_s: float, compared_s: float
) -> None:
    """Queues of a whole peak are not compared with those of its beginning."""
    config = replace(QUICK, parts=("effects",), simulated_s=300.0)
    env = parallel_env(SCENARIO)
    prior, view = street_prior(env, config), LaneView.of(env.network, "count")
    rule = make_rule("fixed-time:20", env)
    env.close()
    log = recorded("sim", recorded_s)
    shown = simulation(simulated_s)
    street, history = fit_street(log, shown, rule, prior, view, config, seed=0)
    decisions = compared_s / log.provenance.decision_interval_s
    seen = {float(item.summary.rows[0, NAMES.index("mean")]) for item in history.simulated}
    assert seen == {decisions}
    begun = log.first(int(decisions))
    if begun.decisions == log.decisions:
        return
    again, _ = fit_street(begun, shown, rule, prior, view, config, seed=0)
    assert street.posterior is not None and again.posterior is not None
    assert np.array_equal(street.posterior.answer, again.posterior.answer)


def lengths_compared(
    log: TransitionLog, episode_s: float, monkeypatch: pytest.MonkeyPatch
) -> list[list[int]]:
    """Return the decisions of each episode of the logs that a fit compares, the street's first."""
    compared, summary = list[list[int]](), LaneView.summary

    def seen(self: LaneView, log: TransitionLog) -> Summary:
        compared.append(log.frame.group_by("episode", maintain_order=True).len()["len"].to_list())
        return summary(self, log)

    monkeypatch.setattr(LaneView, "summary", seen)
    config = replace(QUICK, parts=("effects",), simulated_s=600.0)
    env = parallel_env(SCENARIO)
    prior, view = street_prior(env, config), LaneView.of(env.network, "count")
    env.close()
    replay = RecordedCommands(log, longest=40)
    fit_street(log.from_step_0(), simulation(episode_s), replay, prior, view, config, seed=0)
    return compared


def test_a_street_is_compared_with_what_fits_behind_the_lead_of_its_log(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A log from 40 s to 500 s, and episodes of 400 s, or of 330 s, which are too short."""
    whole = recorded("sim", 500.0)
    provenance = replace(whole.provenance, from_begin=True)
    log = TransitionLog(provenance, whole.frame.filter(pl.col("step") >= 4))
    compared = lengths_compared(log, 400.0, monkeypatch)
    assert {length for (length,) in compared} == {36}
    with pytest.raises(LogError, match="only 290 s of an episode are left .*--duration-s"):
        lengths_compared(log, 330.0, monkeypatch)


def test_a_late_period_shortens_the_comparison_of_no_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of a period from 300 s to 450 s the decisions before 400 s, the end of an episode, count."""
    whole = recorded("sim", 450.0)
    log = TransitionLog.concatenate([whole.first(40), whole.first(40), whole])
    late = (pl.col("episode") < 2) | (pl.col("step") >= 30)
    log = TransitionLog(replace(log.provenance, from_begin=True), log.frame.filter(late))
    monkeypatch.setattr(street_module, "LEAST_DECISIONS", 10)
    compared = lengths_compared(log, 400.0, monkeypatch)
    assert compared[0] == [40, 40, 10]
    assert sorted({length for (length,) in compared[1:]}) == [10, 40]


def test_a_street_is_compared_without_decisions_that_its_log_never_has(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nine of forty decisions are missing; simulated queues of these do not count either."""
    log = in_part(recorded("sim", 400.0), ~pl.col("step").is_between(1, 9))
    compared = lengths_compared(log, 400.0, monkeypatch)
    assert {length for (length,) in compared} == {31}


def test_a_log_whose_end_is_all_that_an_episode_reaches_is_refused_before_training(
    tmp_path: Path,
) -> None:
    whole = recorded("sim", 900.0)
    provenance = replace(whole.provenance, from_begin=True)
    late = TransitionLog(provenance, whole.frame.filter(pl.col("step") >= 25))
    late.write(tmp_path / "street.parquet")
    street = replace(QUICK, parts=("channel", "effects"))
    ugat = replace(FITTED, street=street)
    config = replace(SMALL, ugat=ugat, real_log=tmp_path / "street.parquet", duration_s=300.0)
    with pytest.raises(LogError, match="only 50 s of an episode are left behind .* episode 0 "):
        transfer(config, tmp_path / "run", workers=1)
    assert not (tmp_path / "run" / "trainings").exists()


def test_a_log_of_the_simulation_itself_shows_no_fault() -> None:
    """The negative control: nothing is late, nothing is dead, and no policy has to begin anew."""
    config = replace(QUICK, parts=("channel", "eyes"))
    env = parallel_env(SCENARIO)
    prior, view = street_prior(env, config), LaneView.of(env.network, "count")
    rule = make_rule("fixed-time:20", env)
    env.close()
    log = recorded("sim", seed=4)
    street, _ = fit_street(log, simulation(900.0), rule, prior, view, config, seed=0)
    assert street.channel is not None and not street.channel.changes
    assert street.eyes is not None and not street.eyes.changes
    assert StreetFit(prior, street).view == (0, False)
    assert street.world(1).effects == street.world(1).parts == ()


def test_unknown_parts_and_too_few_simulations_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="eye"):
        StreetConfig(parts=("eye",))
    for parts in (PARTS, ("eyes",)):
        with pytest.raises(UnknownNameError, match="effect of the library 'foo'"):
            StreetConfig(parts=parts, without=("foo",))
    with pytest.raises(
        OptionError, match="parts is 'eyes'; allowed: a list, of which each is a text"
    ):
        StreetConfig(parts="eyes")  # pyright: ignore[reportArgumentType]
    for wrong, told in (
        ({"simulations": 3}, "street simulations is 3; allowed: >= 20"),
        ({"further": -1}, "street further is -1; allowed: >= 0"),
        ({"judged": -1}, "street judged is -1; allowed: >= 0"),
        ({"simulated_s": float("nan")}, "street simulated_s is nan; allowed: > 0, finite"),
        ({"simulated_s": float("inf")}, "street simulated_s is inf; allowed: > 0, finite"),
    ):
        with pytest.raises(OptionError, match=told):
            StreetConfig(**wrong)
    for wrong, told in (
        ({"most_lag": -1}, "most_lag is -1"),
        ({"most_lag": 2.5}, "most_lag is 2.5; allowed: a whole number"),
        ({"pull": 0.0}, "pull is 0.0; allowed: > 0"),
        ({"refused": 1.0}, "refused is 1.0; allowed: from 0 to below 1"),
        ({"gain": float("nan")}, "gain is nan"),
    ):
        with pytest.raises(OptionError, match=told):
            ChannelConfig(**wrong)
    for wrong, told in (
        ({"most_lag": -1}, "most_lag is -1"),
        ({"together": 0.0}, "together is 0.0; allowed: > 0"),
        ({"filled": 1.5}, "filled is 1.5; allowed: 0 to 1"),
        ({"queue": float("inf")}, "queue is inf"),
        ({"absolute": ()}, "absolute is .*at least one"),
        ({"relative": (0.1, -0.1)}, "relative is .*>= 0"),
    ):
        with pytest.raises(OptionError, match=told):
            EyesConfig(**wrong)
    with pytest.raises(OptionError, match="no transform"):
        UgatConfig(grounding="street").transform({}, 0)


@pytest.mark.parametrize(
    ("config", "given", "told"),
    [
        (StreetConfig, {"rival": None}, "unknown rival None"),
        (StreetConfig, {"rival": ["none"]}, r"unknown rival \['none'\]"),
        (StreetConfig, {"channel": None}, "channel is None; allowed: a ChannelConfig"),
        (StreetConfig, {"residual": {"kind": "timed"}}, "allowed: a ResidualConfig"),
        (StreetConfig, {"eyes": None}, "allowed: an EyesConfig"),
        (ResidualConfig, {"kind": ["none"]}, r"unknown residual \['none'\]"),
        (UgatConfig, {"grounding": ["street"]}, r"unknown grounding \['street'\]"),
        (UgatConfig, {"street": None}, "street is None; allowed: a StreetConfig"),
    ],
)
def test_values_of_other_kinds_are_refused(config: Any, given: dict[str, Any], told: str) -> None:
    with pytest.raises((OptionError, UnknownNameError), match=told):
        config(**given)


@pytest.mark.slow
def test_an_interrupted_training_ends_as_an_unbroken_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    play_nothing(monkeypatch)
    ugat = replace(FITTED, street=QUICK, iterations=2)
    config = replace(SMALL, real=LATE, ugat=ugat)
    transfer(config, tmp_path / "whole", workers=1)
    for task in ("fitting, iteration 1", "fitted street, iteration 2"):
        with pytest.raises(KeyboardInterrupt):
            transfer(config, tmp_path / "broken", resume=True, reporter=KillAt(task), workers=1)
    transfer(config, tmp_path / "broken", resume=True, workers=1)
    for name in ("direct-transfer", "fitted-street"):
        one, other = (weights(tmp_path / run, name) for run in ("whole", "broken"))
        assert np.array_equal(one, other), name
    logged = numbers(tmp_path / "whole")
    assert logged == numbers(tmp_path / "broken")
    assert logged[1, "channel/lag_2"] > 0.5
    assert logged[2, "street/commands"] >= 2.0


def test_worlds_beside_a_log_of_other_commands_get_these_commands(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Else f and its rival of the fitted worlds would differ where the worlds do not."""
    acted: list[tuple[float, object]] = []

    def listening(_street: object, simulation: Simulation, policy: object, *_rest: object) -> None:
        acted.append((simulation.epsilon, policy))

    monkeypatch.setattr(street_training, "street_log", listening)
    simulation = Simulation(load_scenario("single-v1"), {}, epsilon=0.3)
    for replay, expected in (("the log", (0.0, "the log")), (None, (0.3, "the policy"))):
        training = Mock(spec=StreetTraining)
        training.simulation, training.config = simulation, Mock(residual_delay_s=0)
        training.run, training.real = Mock(reporter=Silent()), Mock(replay=lambda r=replay: r)
        training._as_recorded = partial(StreetTraining._as_recorded, training)
        StreetTraining._street_logs(training, Mock(iteration=0), "the policy", Mock(), 2, 0)
        assert acted.pop() == expected


def test_a_world_ends_with_the_period_whose_commands_it_repeats() -> None:
    """Else the last command is held to the end of the longest period, and lanes with red jam."""
    short, whole = recorded("sim", 180.0).first(3), recorded("sim", 180.0, seed=1)
    replay = RecordedCommands(TransitionLog.concatenate([short, whole]))

    def decisions(seconds: float) -> list[int]:
        world = simulation(seconds)
        return [world.play(StreetWorld(), replay, seed, Stop()).decisions for seed in (0, 1)]

    assert decisions(180.0) == [3, 18]
    assert decisions(100.0) == [3, 10]


def test_policies_are_compared_in_processes_as_here() -> None:
    """An executor cannot be sent to its own processes."""
    here = simulation()
    env = here.plain(0)
    policies = [NamedRule("largest-queue:20", env), DQN.of(env, DQNConfig(), 3).policy()]
    env.close()
    with LocalProcesses(1) as processes:
        found = [
            one.compare([StreetWorld()], policies, [7], lambda: None)
            for one in (here, replace(here, workers=processes))
        ]
    assert found[0].shape == (2, 1) and np.array_equal(*found)


def test_the_kept_policy_is_the_one_on_the_street(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    play_nothing(monkeypatch)
    out_there: list[tuple[Policy, Policy | None]] = []
    roll_out_of = StreetTraining._roll_out

    def seen(self: StreetTraining, state: RunState[StreetFit], policy: Policy) -> None:
        out_there.append((policy, state.best))
        roll_out_of(self, state, policy)

    def training_was_bad(
        _self: StreetTraining, state: RunState[StreetFit], *_others: object
    ) -> dict[str, float]:
        state.best = state.direct
        return {}

    monkeypatch.setattr(StreetTraining, "_roll_out", seen)
    monkeypatch.setattr(StreetTraining, "_keep_better", training_was_bad)
    ugat = replace(FITTED, street=QUICK, iterations=2)
    transfer(replace(SMALL, real=LATE, ugat=ugat), tmp_path / "run", workers=1)
    (_, before), (second, kept) = out_there
    assert before is None
    assert second is kept


@pytest.mark.slow
def test_a_rule_that_is_better_in_the_fitted_street_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    play_nothing(monkeypatch)
    compare, out_there = Simulation.compare, list[Policy]()
    roll_out_of = StreetTraining._roll_out

    def rules_are_better(
        self: Simulation, worlds: Any, policies: Any, seeds: Any, on_done: Any
    ) -> NDArray[np.float64]:
        times_s = compare(self, worlds, policies, seeds, on_done)
        for policy, row in zip(policies, times_s, strict=True):
            row[:] = 5.0 if getattr(policy, "spec", "") == "fixed-time:50" else row + 10.0
        return times_s

    def seen(self: StreetTraining, state: RunState[StreetFit], policy: Policy) -> None:
        out_there.append(policy)
        roll_out_of(self, state, policy)

    monkeypatch.setattr(Simulation, "compare", rules_are_better)
    monkeypatch.setattr(StreetTraining, "_roll_out", seen)
    street = replace(QUICK, rule_budget=2)
    config = replace(SMALL, real=LATE, ugat=replace(FITTED, street=street, iterations=2))
    with pytest.raises(KeyboardInterrupt):
        transfer(config, tmp_path, reporter=KillAt("fitting, iteration 2"), workers=1)
    transfer(config, tmp_path, resume=True, workers=1)
    assert rule_in(tmp_path / "policies" / "fitted-street.pt") == "fixed-time:50"
    _, second, resumed = out_there
    assert isinstance(second, NamedRule)
    assert isinstance(resumed, NamedRule)
    assert numbers(tmp_path)[2, "judged/of_the_rule"] == 5.0


def test_so_few_episodes_of_a_rule_are_refused() -> None:
    for budget in (-1, 1):
        with pytest.raises(OptionError, match="rule_budget is .*; allowed: >= 2, or 0"):
            StreetConfig(rule_budget=budget)


@pytest.mark.parametrize(
    ("control", "message"), [("noise", "needs f"), ("shuffled", "leaves no histories")]
)
def test_controls_without_a_meaning_are_refused(
    control: NegativeControl, message: str, tmp_path: Path
) -> None:
    ugat = replace(FITTED, street=QUICK)
    with pytest.raises(OptionError, match=message):
        transfer(replace(SMALL, negative_control=control, ugat=ugat), tmp_path, workers=1)


@pytest.mark.parametrize("own", ["execution_delay=20", "lost_commands=0.2", "phase_order=cyclic"])
def test_commands_are_not_changed_by_the_simulation_and_by_a_channel(own: str) -> None:
    """The channel tells all that becomes of a command, and would be added to the simulation's."""
    fitted = UgatConfig("street")
    with pytest.raises(OptionError, match=rf"changes commands \({own}\).*--street.parts eyes"):
        simulated_worlds(SCENARIO, f"V1+{own}", LATE, fitted, {})
    without = replace(fitted, street=replace(fitted.street, parts=("eyes", "service", "effects")))
    simulated_worlds(SCENARIO, f"V1+{own}", LATE, without, {})
    simulated_worlds(SCENARIO, f"V1+{own}", LATE, UgatConfig("phase"), {})
    simulated_worlds(SCENARIO, "V1+counting_noise=0.1+min_green=10", LATE, fitted, {})


def in_part(log: TransitionLog, kept: pl.Expr) -> TransitionLog:
    return TransitionLog(log.provenance, log.frame.filter(kept))


def test_a_log_without_histories_is_refused() -> None:
    log = recorded(LATE, 300)
    step = pl.col("step")
    most = QUICK.longest_lag
    require_histories(log, most)
    require_histories(in_part(log, step != 9), most)  # one decision was lost
    shuffled = log.frame.sample(fraction=1.0, shuffle=True)
    require_histories(TransitionLog(log.provenance, shuffled), most)
    alone = log.frame.with_columns(episode=step, step=pl.lit(0, dtype=log.frame["step"].dtype))
    alone = alone.with_columns(pl.col("episode").cast(log.frame["episode"].dtype))
    short = log.frame.with_columns(episode=step // 6, step=step % 6)
    short = short.cast({name: log.frame[name].dtype for name in ("episode", "step")})
    for broken in (
        in_part(log, step % 2 == 0),
        in_part(log, step % 3 > 0),
        TransitionLog(log.provenance, alone),
        TransitionLog(log.provenance, short),
    ):
        with pytest.raises(LogError, match="decisions right before them"):
            require_histories(broken, most)
        with pytest.raises(LogError, match="decisions right before them"):
            fit_street(broken, None, None, None, None, QUICK, 0)  # pyright: ignore[reportArgumentType]


def test_histories_are_as_long_as_the_delays_that_are_looked_for() -> None:
    log = recorded(LATE, 300)
    six = log.frame.with_columns(episode=pl.col("step") // 6, step=pl.col("step") % 6)
    short = TransitionLog(
        log.provenance, six.cast({name: log.frame[name].dtype for name in ("episode", "step")})
    )
    near = replace(QUICK, channel=ChannelConfig(most_lag=4))
    assert near.longest_lag == 4 and replace(QUICK, parts=("service",)).longest_lag == 1
    require_histories(short, near.longest_lag)
    far = replace(QUICK, channel=ChannelConfig(most_lag=8)).longest_lag
    with pytest.raises(LogError, match="whole episodes of 10 decisions"):
        require_histories(short, far)


def test_a_broken_log_ends_a_training_before_it_begins(tmp_path: Path) -> None:
    log = in_part(recorded(LATE, 300), pl.col("step") % 2 == 0)
    log.write(tmp_path / "street.parquet")
    ugat = replace(FITTED, street=QUICK)
    config = replace(SMALL, ugat=ugat, real_log=tmp_path / "street.parquet")
    with pytest.raises(LogError, match="decisions right before them"):
        transfer(config, tmp_path / "run", workers=1)


@pytest.mark.parametrize(("zone_m", "most_m"), [(None, 0.0), (20.0, 30.0), (50.0, 100.0)])
def test_a_zone_is_found_in_light_traffic(zone_m: float | None, most_m: float) -> None:
    """Queues never fill it there, but vehicles leave lanes that seemed to be empty."""
    light = scenario_in_domain(SCENARIO, "demand_level=*,0.3")
    config = replace(QUICK, parts=("eyes",))
    alone = Simulation(light, {"duration_s": 2400.0}, epsilon=0.3, workers=1)
    env = parallel_env(light)
    prior, view = street_prior(env, config), LaneView.of(env.network, env.options.observation)
    rule = make_rule("fixed-time:20", env)
    env.close()
    zone = () if zone_m is None else (DetectionZone(zone_m),)
    with kept_warm():
        log = alone.play(StreetWorld(parts=zone), rule, 5, Stop())
        street, _ = fit_street(log, alone, rule, prior, view, config, seed=0)
    assert street.eyes is not None
    if zone_m is None:
        assert not street.eyes.changes
    else:
        low_m, high_m = street.eyes.zone_m
        assert zone_m / 2 <= low_m < zone_m < high_m <= most_m


def test_detectors_are_compared_over_equally_long_logs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a street and a simulation of different lengths the common beginning is compared."""
    seen: list[int] = []

    def fit(real: TransitionLog, simulated: TransitionLog, *_: object) -> Eyes:
        seen.extend((real.decisions, simulated.decisions))
        return fit_eyes(real, simulated, view)

    monkeypatch.setattr("ugat_marl.grounding.street.fit_eyes", fit)
    config = replace(QUICK, parts=("eyes",))
    env = parallel_env(SCENARIO)
    prior, view = street_prior(env, config), LaneView.of(env.network, "count")
    rule = make_rule("fixed-time:20", env)
    env.close()
    log = recorded("sim", 100)
    for seconds, decisions in ((60.0, 6), (300.0, 10)):
        fit_street(log, simulation(seconds), rule, prior, view, config, seed=0)
        assert seen[-2:] == [decisions, decisions]


def test_detectors_are_compared_over_hours_that_the_simulation_plays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of a period from 100 s to 300 s only the decisions before 200 s, the end of an episode."""
    seen: list[int] = []

    def fit(real: TransitionLog, simulated: TransitionLog, *_: object) -> Eyes:
        seen.extend(real.frame.group_by("episode", maintain_order=True).len()["len"].to_list())
        return fit_eyes(real, simulated, view)

    monkeypatch.setattr("ugat_marl.grounding.street.fit_eyes", fit)
    config = replace(QUICK, parts=("eyes",))
    env = parallel_env(SCENARIO)
    prior, view = street_prior(env, config), LaneView.of(env.network, "count")
    env.close()
    whole = recorded("sim", 300)
    log = TransitionLog.concatenate([whole.first(20), whole])
    late = (pl.col("episode") < 1) | (pl.col("step") >= 10)
    log = TransitionLog(replace(log.provenance, from_begin=True), log.frame.filter(late))
    replay = RecordedCommands(log, longest=20)
    fit_street(log.from_step_0(), simulation(200.0), replay, prior, view, config, seed=0)
    assert seen == [20, 10]


@pytest.mark.slow
def test_a_learner_begins_anew_when_late_commands_are_found_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first fit finds late commands, the second none; a learner of both would not fit."""
    play_nothing(monkeypatch)
    fit, views = StreetTraining._fit, list[tuple[int, bool]]()

    def found_once(
        self: StreetTraining, state: RunState[StreetFit], policy: Policy
    ) -> FittedStreet:
        street = fit(self, state, policy)
        if state.iteration:
            street = state.transform.street = replace(street, channel=None)
        views.append(state.transform.view)
        return street

    monkeypatch.setattr(StreetTraining, "_fit", found_once)
    config = replace(SMALL, real=LATE, ugat=replace(FITTED, street=QUICK, iterations=2))
    transfer(config, tmp_path, workers=1)
    assert views[0][0] > 0
    assert views[1][0] == 0
    rows = pl.read_parquet(tmp_path / "metrics.parquet").filter(
        pl.col("stage") == "episode", pl.col("name") == "return"
    )
    assert rows["step"].to_list() == list(range(rows.height)), "learners count on"
