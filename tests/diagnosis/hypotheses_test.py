"""The library: where effects are now, within which ranges, and in which order they are applied."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ugat_marl.diagnosis import Hypothesis, free_values, global_hypotheses, ordered
from ugat_marl.diagnosis.hypotheses import LOCAL, a_few, cautious_drivers, library, merged
from ugat_marl.effects import (
    PAPER_WORLDS,
    apply_effects,
    known_effects,
    load_scenario,
    parse_domain,
)
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.scenarios import Scenario

Crossing = Callable[..., Path]


def by_name(scenario: Scenario) -> dict[str, Hypothesis]:
    return {item.name: item for item in global_hypotheses(scenario, library())}


@pytest.fixture(scope="module")
def single() -> Scenario:
    return load_scenario("single-v1")


def test_nominal_values_are_those_of_the_vehicle_types(single: Scenario) -> None:
    found = by_name(single)
    nominal = {name: item.nominal for name, item in found.items()}
    assert nominal["acceleration"] == (2.6,)
    assert nominal["deceleration"] == (4.5,)
    assert nominal["headway"] == (1.0,)
    assert nominal["min_gap"] == (2.5,)
    assert nominal["imperfection"] == (0.5,)
    assert nominal["startup_delay"] == (0.0,)
    assert nominal["heavy_share"] == (0.0,)


TYPES = """<vType id="slow" vClass="passenger" length="5" minGap="2.5" accel="1.5" decel="4.5"
    tau="1.4" sigma="0" speedFactor="1" speedDev="0"/>
    <vType id="odd" vClass="passenger" accel="2.5" decel="4.5" tau="normal(1,0.1)"/>"""
CARS = '<vehicle id="one" type="car" route="north" depart="0"/>'


def test_types_that_disagree_are_averaged(crossing: Crossing) -> None:
    # accel 2.5 and 1.5; sigma 0, and SUMO's 0.5 of the passenger cars that do not say it.
    found = by_name(load_scenario(crossing(vehicles=CARS, types=TYPES)))
    assert found["acceleration"].nominal == (2.0,)
    assert found["deceleration"].nominal == (4.5,)
    assert found["imperfection"].nominal == (0.25,)


def test_trucks_alone_do_not_say_how_cars_accelerate(crossing: Crossing) -> None:
    types = '<vType id="lorry" vClass="truck" accel="1.3"/><vType id="plain"/>'
    cars = CARS.replace('"car"', '"plain"')
    found = by_name(load_scenario(crossing(vehicles=cars, types=types)))
    values = {1.3, 2.6, 2.5}  # the type of the fixture has 2.5
    assert found["acceleration"].nominal == pytest.approx((sum(values) / 3,))


def test_of_several_types_no_number_changes_nothing(crossing: Crossing) -> None:
    found = by_name(load_scenario(crossing(vehicles=CARS, types=TYPES)))
    mixed, alike = found["acceleration"], found["deceleration"]
    assert not mixed.is_nothing((2.0,))
    assert mixed.matters((2.0,))
    assert merged((), ((mixed, (2.0,)),)) == ((mixed, (2.0,)),)
    assert alike.is_nothing((4.5,))
    assert not alike.matters((4.5,))
    assert merged((), ((alike, (4.5,)),)) == ()


def test_the_spread_of_speeds_is_read_off_the_speed_factors(single: Scenario) -> None:
    even = by_name(apply_effects(single, parse_domain("speed_spread=0.03")))["speed_spread"]
    assert (even.nominal, even.levels, even.neutral) == ((0.03,), ((0.2,),), True)
    # normc(1,0.1,0.2,2) of the cars, normc(1,0.05,0.2,2) of the trucks
    mixed = by_name(load_scenario("mixed-v1"))["speed_spread"]
    assert mixed.nominal == (pytest.approx(0.075),)
    assert not mixed.neutral


def test_what_is_no_number_is_taken_as_sumos_default(crossing: Crossing) -> None:
    found = by_name(load_scenario(crossing(vehicles=CARS, types=TYPES)))
    assert found["headway"].nominal == (1.0,)


def test_levels_that_change_nothing_are_not_tried(crossing: Crossing) -> None:
    slow = TYPES.split("/>")[0].replace('accel="1.5"', 'accel="0.3"') + "/>"
    # accel 2.5 and 0.3: mean 1.4, one of the levels.
    found = by_name(load_scenario(crossing(vehicles=CARS, types=slow)))
    assert found["acceleration"].nominal == (1.4,)
    assert (1.4,) not in found["acceleration"].levels
    assert len(found["acceleration"].levels) == 2


def test_the_reaction_step_starts_at_the_step_of_the_simulation(single: Scenario) -> None:
    item = by_name(single)["reaction_step"]
    assert item.nominal == (1.0,)
    assert item.levels == ((2.0,),)
    assert item.clipped((1.4,)) == (1.0,)
    assert item.clipped((2.6,)) == (3.0,)


@pytest.mark.parametrize(
    ("settings", "nominal", "level"),
    [
        ({"step_length_s": 0.5}, 0.5, 2.0),
        ({"step_length_s": 0.5, "sumo": {"default.action-step-length": "1.5"}}, 1.5, 3.0),
        ({"sumo": {"default.action-step-length": "0.5"}}, 1.0, 2.0),
    ],
)
def test_a_reaction_step_that_changes_nothing_is_sumos_own(
    single: Scenario, settings: dict[str, Any], nominal: float, level: float
) -> None:
    item = by_name(with_settings(single, **settings))["reaction_step"]
    assert (item.nominal, item.levels) == ((nominal,), ((level,),))
    assert item.is_nothing((nominal,))


@pytest.mark.parametrize(("seconds", "levels"), [(2, ((4.0,),)), (3, ((5.0,),)), (5, ())])
def test_strengths_are_those_that_are_simulated(
    single: Scenario, seconds: int, levels: tuple[tuple[float, ...], ...]
) -> None:
    """Twice the reaction step may lie beyond its range."""
    item = by_name(apply_effects(single, parse_domain(f"reaction_step={seconds}")))["reaction_step"]
    assert item.levels == levels


def with_settings(scenario: Scenario, **changed: Any) -> Scenario:
    return replace(scenario, settings=scenario.settings.model_copy(update=changed))


def test_drivers_that_are_there_already_are_no_hypothesis(
    single: Scenario, crossing: Crossing
) -> None:
    def models(scenario: Scenario) -> list[str]:
        found = global_hypotheses(scenario, {"driver_model"})
        return [dict(item.fixed)["model"] for item in found]

    assert models(single) == ["IDM", "EIDM", "W99"]
    by_option = with_settings(single, sumo={"default.carfollowmodel": "EIDM"})
    assert models(by_option) == ["IDM", "W99"]
    types = '<vType id="x" vClass="passenger" carFollowModel="IDM"/>'
    assert models(load_scenario(crossing(vehicles=CARS, types=types))) == ["EIDM", "W99"]


def test_effects_that_are_left_out_are_not_examined(single: Scenario) -> None:
    allowed = library(("headway", "turning"))
    assert not {"headway", "turning"} & allowed
    assert "headway" not in {item.name for item in global_hypotheses(single, allowed)}
    with pytest.raises(UnknownNameError, match="no_such_thing"):
        library(("no_such_thing",))


def test_the_library_holds_every_effect_that_can_be_diagnosed() -> None:
    # Clearance times are read off the log.
    assert set(known_effects()) - library() == {"all_red_time", "yellow_time"}
    assert library() <= set(known_effects())


def test_every_level_of_every_hypothesis_is_an_effect(single: Scenario) -> None:
    for item in global_hypotheses(single, library()):
        assert item.name not in LOCAL
        assert item.levels, item.name
        for level in item.levels:
            assert item.clipped(level) == pytest.approx(level), "outside its plausible range"
            assert item.effect(level).name == item.name
            assert item.nominal is None or item.matters(level)


def test_values_are_brought_into_range() -> None:
    allowed = known_effects()["headway"].ranges["seconds"]
    item = Hypothesis("headway", (), ("seconds",), ((1.5,),), (1.0,), 0.05)
    assert item.clipped((-5.0,)) == (allowed.low,)
    assert item.clipped((1e9,)) == (allowed.high,)
    assert item.clipped((1.23456789,)) == (1.2346,)
    assert item.effect((1e9,)) == known_effects()["headway"](allowed.high)


def test_small_strengths_do_not_matter() -> None:
    item = Hypothesis("headway", (), ("seconds",), ((1.5,),), (1.0,), 0.05)
    assert not item.matters((1.04,))
    assert not item.matters((0.96,))
    assert item.matters((1.06,))
    assert Hypothesis("driver_model", (("model", "IDM"),), (), ((),), None).matters(())


def test_what_may_stand_in_a_model_once() -> None:
    def surge(edge: str, begin: float) -> Hypothesis:
        fixed = (("edge", edge), ("begin_s", begin), ("end_s", begin + 600.0))
        return Hypothesis("demand_surge", fixed, ("factor",), ((1.5,),), (1.0,))

    assert surge("a", 0.0).key == surge("a", 300.0).key, "one surge per place"
    assert surge("a", 0.0).key != surge("b", 0.0).key


def test_roads_and_demand_come_first_and_detectors_last() -> None:
    wanted = (
        *parse_domain("demand_level=*,1.2"),
        *parse_domain("driver_model=IDM"),
        *parse_domain("headway=1.4"),
        *parse_domain("heavy_share=0.1"),
        *parse_domain("undercount=*,0.1"),
    )
    for shuffled in itertools.permutations(wanted):
        assert ordered(shuffled) == wanted


def test_trucks_keep_their_own_acceleration() -> None:
    names = [e.name for e in ordered(parse_domain("heavy_share=0.1") + parse_domain("V1"))]
    assert names.index("heavy_share") > names.index("acceleration")


def test_cautious_drivers_are_starting_points(single: Scenario) -> None:
    mild, strong = cautious_drivers(global_hypotheses(single, library()))
    assert [(h.name, value) for h, value in mild] == [
        ("acceleration", (1.6,)), ("deceleration", (3.2,)), ("startup_delay", (0.3,)),
    ]  # fmt: skip
    assert [value for _, value in strong] == [(0.8,), (2.0,), (1.2,)]
    assert cautious_drivers([]) == []


def test_livelier_drivers_are_no_cautious_ones(single: Scenario) -> None:
    def starts(*texts: str) -> list[list[float]]:
        scenario = apply_effects(single, [effect for x in texts for effect in parse_domain(x)])
        found = cautious_drivers(global_hypotheses(scenario, library()))
        return [[value for _, (value,) in members] for members in found]

    assert starts("deceleration=2.6", "startup_delay=0.5") == [[1.6, 2.0, 0.6], [0.8, 2.0, 1.2]]
    assert starts("acceleration=0.7") == []
    assert starts("startup_delay=1.3") == []


def test_no_world_of_the_paper_is_a_starting_point(single: Scenario) -> None:
    # A search that begins at the worlds it is tried on would find them for a wrong reason.
    hypotheses = global_hypotheses(single, library())
    worlds = {(e.name, hypothesis_value(e)) for world in PAPER_WORLDS.values() for e in world}
    starts = {(h.name, value) for start in cautious_drivers(hypotheses) for h, value in start}
    starts |= {(h.name, level) for h in hypotheses for level in h.levels}
    assert worlds & starts == set()


def hypothesis_value(effect: object) -> tuple[float, ...]:
    (value,) = (v for k, v in effect.record().items() if k != "name")  # type: ignore[attr-defined]
    return (float(value),)


def test_a_field_that_an_effect_does_not_have_is_refused() -> None:
    item = Hypothesis("headway", (), ("metres",), ((1.5,),), (1.0,))
    with pytest.raises(OptionError, match="headway"):
        free_values(parse_domain("headway=1.4")[0], item)


def test_an_emergency_deceleration_is_tried_near_the_usual_one(single: Scenario) -> None:
    known = by_name(single)
    gentle = ((known["deceleration"], (1.5,)), (known["acceleration"], (0.5,)))
    alone = a_few(known["emergency_deceleration"])
    assert a_few(known["emergency_deceleration"], gentle) == (*alone, (pytest.approx(1.95),))
    assert a_few(known["headway"], gentle) == a_few(known["headway"])
