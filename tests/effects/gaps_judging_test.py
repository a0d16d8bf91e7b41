"""The reward gap: what the owner of the street wants is measured, and never trained on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ugat_marl
from ugat_marl.data import Scores
from ugat_marl.effects import (
    OBJECTIVES,
    apply_effects,
    load_scenario,
    parse_domain,
    scenario_in_domain,
)
from ugat_marl.effects.objectives import NORMS
from ugat_marl.envs import OBJECTIVE_MEASURES
from ugat_marl.envs.objectives import PERSONS, PERSONS_IN_A_CAR, Objectives, gini, hidden_measures
from ugat_marl.errors import UnknownNameError
from ugat_marl.scenarios import Document
from ugat_marl.simulation import Trips, read_trips
from ugat_marl.simulation.trips import STATISTICS
from ugat_marl.testing.episodes import play, random_actions


def trips(delays: list[float], persons: list[float], co2_g: list[float], **other: Any) -> Trips:
    count = len(delays)
    yes = np.ones(count, dtype=np.bool_)
    return Trips(
        np.array(delays), np.array(delays), yes, other.get("entered", yes),
        np.array(co2_g), np.array(persons), np.array(other.get("dangers", (0.0, 0.0))),
    )  # fmt: skip


def objectives(wanted: str, scenario: str) -> Objectives:
    made = Objectives.of(parse_domain(f"objective={wanted}"), load_scenario(scenario))
    assert made is not None
    return made


def test_trucks_of_the_effect_are_trucks() -> None:
    effects = parse_domain("heavy_share=0.3+objective=person-delay")
    mixed = apply_effects(load_scenario("single-v1"), effects)
    made = Objectives.of(effects, mixed)
    assert made is not None
    heavy = {name: persons for name, persons in made.persons.items() if name.startswith("heavy.")}
    assert set(heavy.values()) == {1.0} and made.persons[""] == PERSONS_IN_A_CAR
    types = [tag for document in (*mixed.additional, *mixed.routes) for tag in document.scan()
             if tag.name == "vType" and tag.attributes["id"] in heavy]  # fmt: skip
    assert types and all("/RT_" in tag.attributes["emissionClass"] for tag in types)


# --- by hand


@pytest.mark.parametrize(
    ("values", "expected"),
    [([3, 3, 3], 0.0), ([0, 0, 0, 8], 0.75), ([1, 3], 0.25), ([1, 2, 3, 4], 0.25), ([0, 0], 0.0),
     ([], 0.0)],
)  # fmt: skip
def test_the_gini_coefficient(values: list[float], expected: float) -> None:
    assert gini(np.array(values, dtype=float)) == pytest.approx(expected)
    pairs = np.abs(np.subtract.outer(values, values)).sum() if values else 0.0
    if sum(values):
        assert gini(np.array(values)) == pytest.approx(pairs / (2 * len(values) * sum(values)))


def test_hidden_measures() -> None:
    entered = np.array([True, True, True, True, False])
    found = hidden_measures(
        trips([0, 10, 20, 30, 40], [1.5, 1.5, 1.5, 25, 1.5], [100, 200, 300, 400, 0],
              entered=entered, dangers=(1.0, 8.0))
    )  # fmt: skip
    assert found["co2_g"] == 250.0
    assert found["person_delay_s"] == pytest.approx((1.5 * 70 + 25 * 30) / 31)
    assert found["delay_p95_s"] == pytest.approx(38.0)
    assert found["delay_gini"] == pytest.approx(0.4)
    assert (found["collisions"], found["hard_brakings"]) == (250.0, 2000.0)
    assert {"cost", *found} == set(OBJECTIVE_MEASURES)


@pytest.mark.parametrize("wanted", OBJECTIVES)
def test_the_cost_is_the_weighted_sum(wanted: str) -> None:
    judge = objectives(wanted, "single-v1")
    scores = Scores(100, 90, 500, -3, 20.0, 0.4, 50, 520, 515, 5)
    told = trips([0, 30], [1.5, 1.5], [300, 900], dangers=(1.0, 2.0))
    hidden = judge.judged(scores, told).hidden
    parts = {
        "queue": 20.0 / 10, "delay": 0.4, "co2_g": 600 / 300, "delay_gini": 0.5 / 0.5,
        "hard_brakings": 1000 / 10, "collisions": 500 / 1, "person_delay_s": 15 / 60,
    }  # fmt: skip
    expected = sum(weight * parts[name] for name, weight in OBJECTIVES[wanted].items())
    assert hidden["cost"] == pytest.approx(expected)
    assert set(parts) == set(NORMS)


def test_persons_follow_the_vehicle_s_class() -> None:
    persons = objectives("person-delay", "mixed-v1").persons
    own = {"car": PERSONS_IN_A_CAR, "truck": PERSONS["truck"]}
    assert persons == {"": PERSONS_IN_A_CAR, "DEFAULT_BIKETYPE": PERSONS["bicycle"], **own}


def test_a_name_makes_no_truck() -> None:
    kinds = '<vType id="heavy.bus" vClass="bus"/><vType id="heavy.car" vClass="passenger"/>'
    document = Document("t.add.xml", None, f"<additional>{kinds}</additional>".encode())
    scenario = replace(load_scenario("single-v1"), additional=(document,))
    effects = parse_domain("heavy_share=0.5+objective=person-delay")
    made = Objectives.of(effects, apply_effects(scenario, effects))
    assert made is not None
    assert made.persons["heavy.bus"] == PERSONS["bus"]
    assert made.persons["heavy.car"] == PERSONS_IN_A_CAR


TRIPINFO = """<tripinfos>
    <tripinfo id="a" depart="0" arrival="50" departDelay="2" duration="50" timeLoss="5" vType="car">
        <emissions CO2_abs="120000" CO_abs="7"/>
    </tripinfo>
    <tripinfo id="b" depart="9" arrival="-1" departDelay="0" duration="91" timeLoss="60"
              vType="bus">
        <emissions CO2_abs="800500"/>
    </tripinfo>
    <tripinfo id="c" depart="-1" arrival="-1" departDelay="70" duration="0" timeLoss="0"
              vType="car"/>
</tripinfos>"""
SAFETY = '<statistics><safety collisions="2" emergencyStops="1" emergencyBraking="7"/></statistics>'


def test_what_sumo_reports(tmp_path: Path) -> None:
    (tmp_path / "trips.xml").write_text(TRIPINFO)
    (tmp_path / STATISTICS).write_text(SAFETY)
    found = read_trips(tmp_path / "trips.xml", 100.0, {"": 1.5, "bus": 25.0})
    assert found.co2_g.tolist() == [120.0, 800.5, 0.0]
    assert found.persons.tolist() == [1.5, 25.0, 1.5]
    assert found.dangers.tolist() == [2.0, 7.0]
    plain = read_trips(tmp_path / "trips.xml", 100.0)
    assert not (plain.co2_g.size or plain.persons.size or plain.dangers.size)
    assert np.array_equal(plain.delay_s, found.delay_s)


def test_unknown_objectives() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'emissions'"):
        parse_domain("objective=emission")


# --- in the running environment


def episode(domain: str, **options: Any) -> Any:
    env = ugat_marl.parallel_env("mixed-v1", domain, duration_s=600, **options)
    try:
        return play(env, 3, random_actions(3), 1000)
    finally:
        env.close()


def test_traffic_rewards_and_observations_stay() -> None:
    plain = episode("sim")
    judged = episode("objective=emissions")
    assert plain.scores.hidden == {}
    assert set(judged.scores.hidden) == set(OBJECTIVE_MEASURES)
    for ours, theirs in zip(judged.moments, plain.moments, strict=True):
        for agent in theirs.observations:
            assert np.array_equal(ours.observations[agent], theirs.observations[agent])
        assert ours.parts.get("rewards") == theirs.parts.get("rewards")
    for name in ("att_s", "throughput", "reward", "queue", "delay", "delay_s", "due", "departed"):
        assert getattr(judged.scores, name) == getattr(plain.scores, name), name
    assert 20 < judged.scores.hidden["co2_g"] < 2000
    assert 0 < judged.scores.hidden["delay_gini"] < 1


def test_the_same_in_worker_processes_and_for_every_objective() -> None:
    here = episode("objective=emissions", simulator="inprocess").scores.hidden
    there = episode("objective=fairness").scores.hidden
    assert {k: v for k, v in here.items() if k != "cost"} == {
        k: v for k, v in there.items() if k != "cost"
    }
    assert here["cost"] != there["cost"]


def test_hard_braking_is_counted() -> None:
    """Drivers who brake late and hard brake hard more often."""
    gentle = episode("objective=safety").scores.hidden["hard_brakings"]
    harsh = episode("objective=safety+deceleration=1+emergency_deceleration=9").scores.hidden
    assert harsh["hard_brakings"] > gentle


def test_the_scenario_keeps_the_objective(tmp_path: Path) -> None:
    changed = scenario_in_domain(load_scenario("single-v1"), "objective=Safety")
    assert changed.applied == ("objective=safety",)
    assert load_scenario(load_scenario(changed.write(tmp_path / "written"))).hash == changed.hash
