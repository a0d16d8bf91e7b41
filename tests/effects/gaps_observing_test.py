"""The observation gap: controllers see other counts; traffic, rewards and scores stay."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import libsumo
import numpy as np
import pytest
from numpy.typing import NDArray

import ugat_marl
from ugat_marl.diagnosis.hypotheses import library
from ugat_marl.effects import (
    OBSERVATION_EFFECTS,
    Effect,
    apply_effects,
    controller_effects,
    detector_effects,
    known_effects,
    load_scenario,
    parse_domain,
    scenario_in_domain,
)
from ugat_marl.effects.sensors import DeadDetectors
from ugat_marl.effects.table import ON_CONTROLLERS
from ugat_marl.envs import Infos, Observations
from ugat_marl.envs.observations import COUNT_SCALE
from ugat_marl.envs.sensors import Sensors
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.policies import observer_of, roll_out
from ugat_marl.scenarios import Network
from ugat_marl.simulation import HALTING_MPS, Snapshot
from ugat_marl.testing.episodes import play, random_actions

EXAMPLES = (
    "counting_noise=0.1", "counting_error=3", "detector_failure=0.5", "detection_zone=50",
    "observation_delay=20", "lost_readings=0.3", "quantised_counts=5",
)  # fmt: skip
DECISIONS = 2000


@pytest.fixture(scope="module")
def network() -> Network:
    return Network.read(load_scenario("single-v1"))


def sensors(domain: str, network: Network, seed: int = 1) -> Sensors:
    made = Sensors.of(parse_domain(domain), network, 10.0)
    assert made is not None
    made.reset(seed)
    return made


def dead(street: Sensors) -> NDArray[np.bool_]:
    """Lanes with a dead detector in this episode."""
    return next(x.dead for x in street.chain if isinstance(x, DeadDetectors))


def snapshot(network: Network, vehicles: float, halting: float, waiting: float = 0.0) -> Snapshot:
    lanes = np.ones(len(network.lane_table().ids))
    near = np.array([lanes * vehicles / 2, lanes * halting / 2, lanes * waiting / 2, lanes])
    return Snapshot(
        10.0, lanes * vehicles, lanes * halting, lanes * 3.0, lanes * waiting, 5, 0, near=near
    )


def seen(
    domain: str, network: Network, vehicles: float, halting: float, seed: int = 1
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Vehicles and halting vehicles as they are seen in many decisions, ``(decisions, lanes)``."""
    street, measured = sensors(domain, network, seed), snapshot(network, vehicles, halting)
    looks = [street.see(measured) for _ in range(DECISIONS)]
    return np.array([x.vehicles for x in looks]), np.array([x.halting for x in looks])


# --- values


def test_no_diagnosis_looks_for_them() -> None:
    ours = {kind.name for kind in OBSERVATION_EFFECTS}
    assert ours <= set(ON_CONTROLLERS)
    assert not set(ON_CONTROLLERS) & set(known_effects())
    assert not set(ON_CONTROLLERS) & library()


def test_every_effect_has_an_example() -> None:
    assert [text.partition("=")[0] for text in EXAMPLES] == [
        kind.name for kind in OBSERVATION_EFFECTS
    ]


@pytest.mark.parametrize("text", EXAMPLES)
def test_the_scenario_keeps_the_effect(text: str, tmp_path: Path) -> None:
    scenario = load_scenario("single-v1")
    changed = scenario_in_domain(scenario, text)
    assert controller_effects(changed) == parse_domain(text)
    assert changed.documents == scenario.documents
    assert changed.hash != scenario.hash
    for again in (load_scenario(changed), load_scenario(changed.write(tmp_path / "written"))):
        assert again.hash == changed.hash
        assert again.applied == changed.applied == (text,)
        assert controller_effects(again) == parse_domain(text)
    listed = scenario.settings.model_copy(update={"effects": (parse_domain(text)[0].record(),)})
    assert load_scenario(replace(scenario, settings=listed)).hash == changed.hash


def test_effects_on_controllers_go_with_all_others_in_any_order() -> None:
    scenario = load_scenario("single-v1")
    text = "+".join(("V4", *EXAMPLES))
    both = scenario_in_domain(scenario, text)
    assert set(map(str, controller_effects(both))) == set(EXAMPLES)
    other = apply_effects(
        scenario_in_domain(scenario, "V4"), parse_domain("+".join(EXAMPLES))[::-1]
    )
    assert both.hash == other.hash != scenario_in_domain(scenario, "V4").hash
    last = scenario_in_domain(scenario, "counting_noise=0.1+counting_noise=0.2")
    assert last.hash == scenario_in_domain(scenario, "counting_noise=0.2").hash


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("counting_noise=3", OptionError, r"share = 3.0 is outside \[0, 1\]"),
        ("detection_zone=0", OptionError, r"metres = 0.0 is outside \[1, 1000\] m"),
        ("counting_nois=0.1", UnknownNameError, "Did you mean 'counting_noise'"),
    ],
)
def test_impossible_values(text: str, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        parse_domain(text)


# --- what they do, by hand


def test_without_effects_there_is_nothing_to_do(network: Network) -> None:
    assert Sensors.of(parse_domain("V4+late_green=*,2"), network, 10.0) is None


def test_counting_noise_is_a_share_of_the_count(network: Network) -> None:
    vehicles, halting = seen("counting_noise=0.2", network, 20.0, 10.0)
    assert vehicles.mean() == pytest.approx(20.0, rel=0.01)
    assert vehicles.std() == pytest.approx(4.0, rel=0.03)
    assert np.allclose(halting, vehicles / 2), "one detector, one error"
    assert np.corrcoef(vehicles[:, 0], vehicles[:, 1])[0, 1] == pytest.approx(0.0, abs=0.08)
    assert not seen("counting_noise=0.2", network, 0.0, 0.0)[0].any()


def test_counting_noise_changes_all_counts_alike_and_no_speed(network: Network) -> None:
    street, measured = sensors("counting_noise=1", network), snapshot(network, 20.0, 10.0, 6.0)
    measured = replace(measured, queued_upstream=measured.halting / 2)
    looked = [street.see(measured) for _ in range(20)]
    factors = np.array([x.vehicles for x in looked]) / 20.0
    assert factors.min() == 0.0, "no count is negative"
    assert np.array([x.halting for x in looked]) == pytest.approx(10.0 * factors)
    assert np.array([x.waiting_s for x in looked]) == pytest.approx(6.0 * factors)
    assert np.array([x.queued_upstream for x in looked]) == pytest.approx(5.0 * factors)
    assert np.array([x.mean_speed_mps for x in looked]) == pytest.approx(3.0)


def test_noise_and_error_of_a_seed_are_independent(network: Network) -> None:
    noise, _ = seen("counting_noise=0.1", network, 50.0, 50.0)
    error, _ = seen("counting_error=5", network, 50.0, 50.0)
    assert abs(np.corrcoef(noise.ravel(), error.ravel())[0, 1]) < 0.05


def test_a_counting_error_is_in_vehicles_and_never_negative(network: Network) -> None:
    vehicles, halting = seen("counting_error=3", network, 50.0, 50.0)
    assert vehicles.mean() == pytest.approx(50.0, rel=0.01)
    assert vehicles.std() == pytest.approx(3.0, rel=0.03)
    assert np.array_equal(halting, vehicles)
    empty, nobody = seen("counting_error=3", network, 0.0, 0.0)
    assert empty.min() == 0 and nobody.max() <= empty.max()
    assert empty.mean() == pytest.approx(3.0 / np.sqrt(2 * np.pi), rel=0.03)


def test_a_dead_detector_reports_nothing_all_episode(network: Network) -> None:
    vehicles, halting = seen("detector_failure=0.5", network, 4.0, 2.0)
    assert set(np.unique(vehicles)) == {0.0, 4.0} and set(np.unique(halting)) == {0.0, 2.0}
    assert (vehicles == vehicles[0]).all()
    shares, before = [], sensors("detector_failure=0.05", network)
    for seed in range(200):
        few = sensors("detector_failure=0.2", network, seed)
        many = sensors("detector_failure=0.7", network, seed)
        assert (dead(few) <= dead(many)).all()
        shares.append((dead(few).mean(), dead(many).mean()))
    assert np.mean(shares, axis=0) == pytest.approx([0.2, 0.7], abs=0.03)
    before.reset(2)
    half, measured = sensors("detector_failure=0.5", network), snapshot(network, 4.0, 2.0)
    left = half.see(replace(measured, mean_left=np.ones_like(measured.vehicles))).mean_left
    assert np.array_equal(left == 0.0, dead(half)), "nobody is seen to leave"
    assert dead(sensors("detector_failure=1", network)).all()


def test_only_the_zone_before_a_stop_line_is_seen(network: Network) -> None:
    street = sensors("detection_zone=50", network)
    assert street.zone_m == 50.0
    measured = snapshot(network, 8.0, 4.0, 6.0)
    looked = street.see(replace(measured, queued_upstream=measured.halting))
    assert not looked.queued_upstream.any(), "they queue outside of the zone"
    incoming = {lane for item in network.intersections for lane in item.incoming_lanes}
    for place, lane in enumerate(network.lane_table().ids):
        expected = (4.0, 2.0, 3.0) if lane in incoming else (0.0, 0.0, 0.0)
        found = looked.vehicles[place], looked.halting[place], looked.waiting_s[place]
        assert found == expected


@pytest.mark.parametrize(
    ("seconds", "decisions"), [(0, 0), (4, 0), (5, 1), (14, 1), (15, 2), (25, 3), (30, 3)]
)
def test_late_counts(seconds: int, decisions: int, network: Network) -> None:
    street = sensors(f"observation_delay={seconds}", network)
    found = [street.see(snapshot(network, n, n)).vehicles[0] for n in range(1, 9)]
    assert found == [max(0, n - decisions) for n in range(1, 9)]


def test_the_last_sensor_of_a_name_counts(network: Network) -> None:
    street = sensors("observation_delay=20+observation_delay=10", network)
    found = [street.see(snapshot(network, n, n)).vehicles[0] for n in range(1, 5)]
    assert found == [0, 1, 2, 3]


def test_sensors_act_in_the_order_of_a_street_however_they_are_named(network: Network) -> None:
    orders = [sensors("+".join(texts), network) for texts in (EXAMPLES, EXAMPLES[::-1])]
    measured = snapshot(network, 20.0, 10.0, 6.0)
    for _ in range(10):
        one, other = (street.see(measured) for street in orders)
        assert np.array_equal(one.vehicles, other.vehicles)
        assert np.array_equal(one.waiting_s, other.waiting_s)


def test_lost_readings_are_seen_again(network: Network) -> None:
    street = sensors("lost_readings=0.3", network)
    found = np.array([street.see(snapshot(network, n, 0)).vehicles for n in range(1, DECISIONS)])
    now = np.arange(1, DECISIONS)[:, None]
    kept = found[1:] == found[:-1]
    assert ((found[1:] == now[1:]) | kept).all()
    assert kept.mean() == pytest.approx(0.3, abs=0.01)
    assert not seen("lost_readings=1", network, 3.0, 3.0)[0].any()


@pytest.mark.parametrize("text", ["observation_delay=30", "lost_readings=0.9"])
def test_vehicles_that_left_are_as_late_as_the_counts(text: str) -> None:
    env = ugat_marl.parallel_env("single-v1", domain=text, duration_s=600, crossings=True)
    log = roll_out(env, _Nobody(), 1, record=observer_of(env)).log
    env.close()
    assert log is not None
    for agent in log.agents:
        served = log.transitions(agent).served_features
        assert served.size and (served >= 0).all()


def test_effects_on_detectors_keep_their_order_beside_one_on_controllers() -> None:
    scenario = load_scenario("single-v1")
    text = "undercount=*,0.5+stuck=d,0,100+dropout=d,50,60"
    plain = detector_effects(scenario_in_domain(scenario, text, recorded=True))
    other = scenario_in_domain(scenario, f"{text}+lost_readings=0.1", recorded=True)
    assert [str(x) for x in detector_effects(other)] == [str(x) for x in plain]


def test_counts_in_steps(network: Network) -> None:
    street = sensors("quantised_counts=5", network)
    found = [street.see(snapshot(network, n, 0)).vehicles[0] for n in (0, 2, 3, 7, 8, 12.5)]
    assert found == [0, 0, 5, 5, 10, 15]


def test_an_effect_does_the_same_beside_others(network: Network) -> None:
    alone = seen("counting_noise=0.2", network, 20.0, 10.0)[0]
    other = seen("counting_noise=0.2+detector_failure=0.3", network, 20.0, 10.0)[0]
    silent = dead(sensors("counting_noise=0.2+detector_failure=0.3", network))
    assert silent.any() and not silent.all()
    assert np.array_equal(other, alone * ~silent)


def test_the_seed_decides_and_a_reset_forgets(network: Network) -> None:
    domain = "counting_noise=0.2+lost_readings=0.2+observation_delay=20+detector_failure=0.3"
    street, measured = sensors(domain, network, 5), snapshot(network, 20.0, 10.0)
    first = [street.see(measured).vehicles for _ in range(20)]
    street.reset(5)
    assert np.array_equal(first, [street.see(measured).vehicles for _ in range(20)])
    street.reset(6)
    assert not np.array_equal(first, [street.see(measured).vehicles for _ in range(20)])


# --- in the running environment


def episode(domain: str, **options: Any) -> Any:
    env = ugat_marl.parallel_env("single-v1", domain, duration_s=400, **options)
    try:
        return play(env, 3, random_actions(3), 1000)
    finally:
        env.close()


@pytest.fixture(scope="module")
def plain() -> Any:
    return episode("sim", observation="movements")


@pytest.mark.parametrize("text", EXAMPLES)
def test_traffic_rewards_and_scores_stay(text: str, plain: Any) -> None:
    other = episode(text, observation="movements")
    assert other.scores == plain.scores
    assert [m.parts["rewards"] for m in other.moments[1:]] == [
        m.parts["rewards"] for m in plain.moments[1:]
    ]
    agent = "signal_0"
    ours = np.array([m.parts["observations"][agent] for m in other.moments])
    theirs = np.array([m.parts["observations"][agent] for m in plain.moments])
    phases = slice(-8, None)
    assert np.array_equal(ours[:, phases], theirs[:, phases])
    assert not np.array_equal(ours, theirs)
    assert ours.min() >= 0 and ours.max() <= 1


ALL = "+".join(EXAMPLES)


def test_the_same_values_in_worker_processes() -> None:
    here, there, spawned = (
        episode(ALL, simulator=kind) for kind in ("inprocess", "process", "spawn")
    )
    for one in (there, spawned):
        for ours, theirs in zip(here.moments, one.moments, strict=True):
            first, second = ours.parts["observations"], theirs.parts["observations"]
            assert first.keys() == second.keys()
            assert all(np.array_equal(first[agent], second[agent]) for agent in first)


class _Looks:
    """Follows along and compares what is seen with what stands before the stop lines."""

    def __init__(self, env: Any, zone_m: float) -> None:
        self.env, self.zone_m, self.compared = env, zone_m, 0
        self.env_options: Mapping[str, Any] = {}

    def reset(self, seed: int) -> None:
        """Nothing to forget."""

    def act(self, observations: Observations, infos: Infos) -> dict[str, int]:
        item = self.env.network.intersections[0]
        near: list[float] = []
        for lane in item.incoming_lanes:
            length = libsumo.lane.getLength(lane)
            api = libsumo.vehicle
            close = [
                name
                for name in libsumo.lane.getLastStepVehicleIDs(lane)
                if length - api.getLanePosition(name) <= self.zone_m
            ]
            near.append(len(close))
            place = self.env.network.lane_table().ids.index(lane)
            slow = sum(api.getSpeed(name) < HALTING_MPS for name in close)
            assert self.env.seen.halting[place] == slow
            waited = sum(api.getWaitingTime(name) for name in close)
            assert self.env.seen.waiting_s[place] == pytest.approx(waited)
            speeds = [api.getSpeed(name) for name in close] or [libsumo.lane.getMaxSpeed(lane)]
            assert self.env.seen.mean_speed_mps[place] == pytest.approx(np.mean(speeds))
            self.compared += self.env.snapshot.vehicles[place] != len(close)
        found = observations["signal_0"][: len(near)] * COUNT_SCALE
        assert found == pytest.approx(near)
        return {"signal_0": 0}


def test_the_zone_is_read_back_from_the_running_simulation() -> None:
    env = ugat_marl.parallel_env(
        "single-v1", "detection_zone=40", duration_s=300, simulator="inprocess", reward="waiting"
    )
    looks = _Looks(env, 40.0)
    try:
        roll_out(env, looks, 1)
    finally:
        env.close()
    assert looks.compared > 20, "the zone makes a difference"


def test_state_and_logs_hold_what_is_seen(crossing: Callable[..., Path]) -> None:
    env = ugat_marl.parallel_env(crossing(), "detector_failure=1", simulator="inprocess")
    try:
        observations, _ = env.reset(seed=1)
        for _ in range(6):
            observations, *_ = env.step({"signal_0": 0})
        assert env.snapshot.vehicles.any() and not env.seen.vehicles.any()
        assert np.array_equal(env.state(), observations["signal_0"])
        assert not observations["signal_0"][: env.layouts["signal_0"].features].any()
        looks = _Nobody()
        log = roll_out(env, looks, 1, record=observer_of(env)).log
    finally:
        env.close()
    assert log is not None
    features = env.layouts["signal_0"].features
    for name in ("observation", "next_observation"):
        assert not np.array(log.frame[name].to_list())[:, :features].any()


class _Nobody:
    env_options: Mapping[str, Any] = {}

    def reset(self, seed: int) -> None:
        """Nothing to forget."""

    def act(self, observations: Observations, infos: Infos) -> dict[str, int]:
        return dict.fromkeys(observations, 0)


def test_all_are_effects() -> None:
    assert all(issubclass(kind, Effect) for kind in OBSERVATION_EFFECTS)
