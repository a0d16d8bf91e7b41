"""Effects on demand and turns: counted by hand, nested by strength, in the order SUMO needs."""

from __future__ import annotations

import contextlib
import math
import subprocess
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from ugat_marl.effects import (
    DemandLevel,
    DemandSurge,
    DemandTiming,
    Effect,
    HeavyShare,
    LaneClosure,
    Parking,
    Turning,
    apply_effects,
    load_scenario,
    parse_domain,
)
from ugat_marl.effects.documents import sort_departures
from ugat_marl.envs import parallel_env
from ugat_marl.errors import OptionError, ScenarioError, UnknownNameError
from ugat_marl.scenarios import (
    Document,
    Network,
    Scenario,
    check_demand,
    demand_as_vehicles,
    sumo_program,
)

Crossing = Callable[..., Path]
EDGE = "east1_A1"


def test_demand_of_a_file_with_effects_lasts_as_long_as_the_episode(crossing: Crossing) -> None:
    flow = '<flow id="f" begin="0" vehsPerHour="360" type="car" route="east"/>'
    record = '\n[[effects]]\nname = "demand_level"\nedge = "*"\nfactor = 1.0\n'
    plain = crossing(vehicles=flow)
    changed = crossing(vehicles=flow, toml=lambda text: text + record)
    due: list[list[int]] = []
    for path in (plain, changed):
        due.append([])
        for seconds in (600, 1800):
            with contextlib.closing(parallel_env(path, duration_s=seconds)) as env:
                env.reset(seed=1)
                while env.agents:
                    env.step({"signal_0": 0})
                due[-1].append(env.scores().due)
    assert due == [[60, 180], [60, 180]]


def departing(scenario: Scenario) -> dict[str, ET.Element]:
    items = [
        item
        for document in scenario.routes
        for item in document.parse()
        if item.tag in ("vehicle", "trip", "flow")
    ]
    found = {item.get("id", ""): item for item in items}
    assert len(found) == len(items), "an id is there twice"
    return found


def edges(item: ET.Element) -> list[str]:
    route = item.find("route")
    assert route is not None
    return route.get("edges", "").split()


def sound(scenario: Scenario) -> Scenario:
    """The scenario, whose routes exist and whose vehicles are in order."""
    check_demand(scenario, Network.read(scenario))
    return scenario


def of_edge(scenario: Scenario, edge: str = EDGE) -> dict[str, ET.Element]:
    return {name: item for name, item in departing(scenario).items() if edges(item)[0] == edge}


def bounds(count: int, share: float) -> float:
    return 4 * (count * share * (1 - share)) ** 0.5


@pytest.mark.parametrize("edge", [EDGE, "*"])
def test_fewer_vehicles_are_nested(edge: str) -> None:
    scenario = load_scenario("single-v1")
    before = departing(scenario) if edge == "*" else of_edge(scenario)
    kept = [
        set(departing(sound(apply_effects(scenario, [DemandLevel(edge, factor)]))))
        for factor in (0.3, 0.6, 0.8, 1.0)
    ]
    assert all(a < b for a, b in pairwise(kept))
    assert kept[-1] == set(departing(scenario))
    for factor, names in zip((0.3, 0.6, 0.8), kept, strict=False):
        assert set(departing(scenario)) - names <= set(before)
        left = len(names & set(before))
        assert left == pytest.approx(len(before) * factor, abs=bounds(len(before), factor))


def test_more_vehicles_are_twins() -> None:
    scenario = load_scenario("single-v1")
    before, all_before = of_edge(scenario), departing(scenario)
    count = len(before)
    twins: list[set[str]] = []
    for factor in (1.0, 1.3, 1.8):
        after = departing(sound(apply_effects(scenario, [DemandLevel(EDGE, factor)])))
        assert set(after) >= set(all_before)
        twins.append(set(after) - set(all_before))
        assert len(twins[-1]) == pytest.approx(count * (factor - 1), abs=bounds(count, factor - 1))
        for name in twins[-1]:
            original = after[name.removesuffix("+1")]
            assert original.get("id") in before
            assert edges(after[name]) == edges(original)
            shift = float(after[name].get("depart", "")) - float(original.get("depart", ""))
            assert abs(shift) <= 15
    assert twins[0] == set()
    assert twins[1] < twins[2]
    threefold = of_edge(apply_effects(scenario, [DemandLevel(EDGE, 3)]))
    assert len(threefold) == 3 * count


def test_nobody_is_left() -> None:
    scenario = load_scenario("single-v1")
    assert not of_edge(apply_effects(scenario, [DemandLevel(EDGE, 0)]))
    assert not departing(apply_effects(scenario, [DemandLevel("*", 0)]))


def test_two_decisions_about_a_vehicle_are_independent() -> None:
    scenario = load_scenario("single-v1")
    count = len(of_edge(scenario))
    both = apply_effects(
        scenario,
        [DemandLevel(EDGE, 0.6), DemandSurge(EDGE, 0, 7200, 0.6), DemandLevel("*", 0.6)],
    )
    assert len(of_edge(both)) == pytest.approx(count * 0.216, abs=bounds(count, 0.216))


def test_the_same_share_twice_is_a_share_of_the_rest(tmp_path: Path) -> None:
    scenario = load_scenario("single-v1")
    everybody = len(departing(scenario))
    twice = apply_effects(scenario, parse_domain("demand_level=*,0.8+demand_level=*,0.8"))
    assert len(departing(twice)) / everybody == pytest.approx(0.64, abs=bounds(everybody, 0.64))
    once = apply_effects(scenario, [DemandLevel("*", 0.8)]).write(tmp_path / "once")
    later = apply_effects(load_scenario(once), [DemandLevel("*", 0.8)])
    assert departing(later).keys() == departing(twice).keys()
    elsewhere = apply_effects(scenario, parse_domain(f"demand_level=*,0.8+demand_level={EDGE},0.8"))
    alone = apply_effects(scenario, parse_domain(f"demand_level={EDGE},0.8+demand_level=*,0.8"))
    assert departing(elsewhere).keys() == departing(alone).keys(), "other places, other decisions"


def test_turning_twice_turns_more() -> None:
    scenario, turn = load_scenario("single-v1"), f"turning={EDGE},A1_southA,0.5"
    once, twice = (
        turns(apply_effects(scenario, parse_domain("+".join([turn] * count)))) for count in (1, 2)
    )
    assert twice["A1_southA"] > 1.2 * once["A1_southA"]


def test_who_turns_drives_on_until_the_network_ends_though_roads_let_him_turn_around(
    tmp_path: Path,
) -> None:
    grid = "--grid --grid.x-number=2 --grid.y-number=1 --grid.attach-length=200 -o n.net.xml"
    options = [*grid.split(), "--default-junction-type=traffic_light"]
    program = str(sumo_program("netgenerate"))
    subprocess.run([program, *options], cwd=tmp_path, check=True, capture_output=True)
    cars = "".join(
        f'<vehicle id="{n}" depart="{n}"><route edges="left0A0 A0top0"/></vehicle>'
        for n in range(50)
    )
    (tmp_path / "r.rou.xml").write_text(f"<routes>{cars}</routes>")
    (tmp_path / "scenario.toml").write_text(
        'network = "n.net.xml"\nroutes = ["r.rou.xml"]\nduration_s = 300\n'
    )
    turned = apply_effects(load_scenario(tmp_path), [Turning("left0A0", "A0B0", 0.5)])
    ends = {edges(item)[-1] for item in departing(turned).values() if "A0B0" in edges(item)}
    assert ends
    assert ends <= {"B0right0", "B0top1", "B0bottom1"}


@pytest.mark.parametrize("space", [" ", "\n", "\t"])
def test_routes_may_be_written_over_several_lines(space: str) -> None:
    route = f'<route{space}id="r" edges="{EDGE} A1_southA"/>'
    scenario = with_routes(route + '<vehicle id="v" route="r" depart="1"/>')
    assert not departing(apply_effects(scenario, [DemandLevel(EDGE, 0.0)]))


def test_who_draws_a_route_of_several_edges_has_no_first_one() -> None:
    routes = (
        f'<routeDistribution id="d"><route edges="{EDGE} A1_southA" probability="1"/>'
        '<route edges="southA_A1 A1_east1" probability="1"/></routeDistribution>'
        '<vehicle id="v" route="d" depart="1"/>'
    )
    inner = (
        '<vehicle id="v" depart="1"><routeDistribution>'
        f'<route edges="{EDGE} A1_southA" probability="1"/>'
        '<route edges="southA_A1 A1_east1" probability="1"/></routeDistribution></vehicle>'
    )
    for text in (routes, inner):
        with pytest.raises(OptionError, match="'v' draws one of several routes, which begin on"):
            apply_effects(with_routes(text), [DemandLevel(EDGE, 0.5)])
        elsewhere = apply_effects(with_routes(text), [DemandLevel("northA_A1", 0.0)])
        assert departing(elsewhere).keys() == {"v"}


@pytest.mark.parametrize(("factor", "names"), [(0.0, set()), (2.0, {"v", "v+1"})])
def test_who_departs_at_the_beginning_is_scaled(factor: float, names: set[str]) -> None:
    scenario = with_routes(
        f'<vehicle id="v" depart="begin"><route edges="{EDGE} A1_southA"/></vehicle>'
    )
    assert departing(apply_effects(scenario, [DemandLevel("*", factor)])).keys() == names


def test_flows_that_begin_with_the_episode_are_changed(crossing: Crossing) -> None:
    flow = '<flow id="f" route="east" begin="begin" end="{}" number="10"/>'
    for effect, numbers in (
        (DemandLevel("*", 0.5), {"f": 5}),
        (DemandLevel("*", 0.0), {}),
        (HeavyShare(1.0), {"f+heavy": 10}),
    ):
        scenario = with_routes(
            '<route id="east" edges="west1_A1 A1_east1"/>' + flow.format(4000), begin_s=3600.0
        )
        found = departing(apply_effects(scenario, [effect]))
        assert {name: int(x.get("number", "")) for name, x in found.items()} == numbers
    later = departing(apply_effects(scenario, [DemandTiming("*", 30)]))
    assert later["f"].get("begin") == "3630"


def test_who_departs_at_the_beginning_is_shifted() -> None:
    route = f'<route edges="{EDGE} A1_southA"/>'
    scenario = with_routes(
        f'<vehicle id="v" depart="begin">{route}</vehicle>'
        f'<vehicle id="w" depart="3610">{route}</vehicle>',
        begin_s=3600.0,
    )
    found = departing(apply_effects(scenario, [DemandTiming("*", 30)]))
    assert [(name, x.get("depart")) for name, x in found.items()] == [("v", "3630"), ("w", "3640")]


@pytest.mark.parametrize("rate", ['period="exp(0.1)"', 'probability="0.1"'])
def test_a_flow_by_chance_keeps_its_number(rate: str) -> None:
    scenario = with_routes(
        '<route id="r" edges="west1_A1 A1_east1"/>'
        f'<flow id="f" route="r" begin="5" number="60" {rate}/>'
    )
    for effect, numbers in (
        (DemandLevel("*", 1.0), [60]),
        (DemandLevel("*", 0.5), [30]),
        (HeavyShare(0.0), [60]),
        (HeavyShare(0.25), [45, 15]),
    ):
        found = departing(apply_effects(scenario, [effect])).values()
        assert sorted(int(x.get("number", "")) for x in found) == sorted(numbers)
        assert all("end" not in x.attrib for x in found)


def test_a_flow_without_an_end_is_shifted_by_as_much() -> None:
    """Departures of 3600, 3900, ... 100 s earlier: that of 3900 is the first one."""
    for first in (0, 3600):
        scenario = with_routes(
            '<route id="r" edges="west1_A1 A1_east1"/>'
            f'<flow id="f" route="r" begin="{first}" period="300"/>',
            begin_s=3650.0,
        )
        for seconds, begin in ((-100, "3800"), (50, "3950"), (-300, "3900")):
            (shifted,) = departing(apply_effects(scenario, [DemandTiming("*", seconds)])).values()
            assert shifted.get("begin") == begin


@pytest.mark.parametrize("factor", [0.0, 2.0])
def test_who_waits_for_a_person_is_left_alone(factor: float) -> None:
    """A twin would wait for ever, and a person for a vehicle that is taken away."""
    scenario = with_routes(
        f'<vehicle id="v" depart="triggered"><route edges="{EDGE} A1_southA"/></vehicle>'
    )
    for effect in (DemandSurge("*", 10.0, 20.0, factor), DemandLevel("*", factor)):
        assert departing(apply_effects(scenario, [effect])).keys() == {"v"}


def test_who_waits_for_a_person_stays_behind_the_vehicle_before() -> None:
    root = ET.fromstring(
        '<routes><vehicle id="a" depart="20"/><vehicle id="b" depart="triggered"/>'
        '<vehicle id="c" depart="10"/><vType id="t"/><vehicle id="d" depart="15"/></routes>'
    )
    sort_departures(root)
    assert [element.get("id") for element in root] == ["t", "c", "d", "a", "b"]


def test_a_surge_stays_in_its_window() -> None:
    scenario = load_scenario("single-v1")
    surge = sound(apply_effects(scenario, [DemandSurge(EDGE, 600, 1200, 1.8)]))
    before, after = departing(scenario), departing(surge)
    new = set(after) - set(before)
    times = [float(after[name].get("depart", "")) for name in new]
    assert all(600 <= time < 1200 for time in times)
    # a twin 5 ms before the end of the window is not rounded into it
    crowd = apply_effects(scenario, [DemandSurge("*", 46.0, 106.0, 20.0)])
    copies = [x for name, x in departing(crowd).items() if name not in before]
    assert all(46 <= float(x.get("depart", "")) < 106 for x in copies)
    inside = sum(600 <= float(x.get("depart", "")) < 1200 for x in of_edge(scenario).values())
    assert len(new) == pytest.approx(inside * 0.8, abs=bounds(inside, 0.8))
    assert {name: ET.tostring(after[name]) for name in before} == {
        name: ET.tostring(item) for name, item in before.items()
    }


def test_demand_may_grow_more_than_once(crossing: Crossing) -> None:
    scenario = load_scenario("single-v1")
    effects = [DemandLevel(EDGE, 1.7), DemandSurge(EDGE, 600, 1200, 2.5), DemandLevel("*", 1.7)]
    grown = sound(apply_effects(scenario, effects))  # no id is there twice
    assert len(departing(grown)) > 1.5 * len(departing(scenario))
    flows = load_scenario(crossing(vehicles=FLOWS))
    surges = [DemandSurge("W_C", 50, 100, 3), DemandSurge("W_C", 20, 70, 2)]
    assert len(departing(apply_effects(flows, surges))) > len(departing(flows)) + 8


def test_departures_are_shifted() -> None:
    scenario = load_scenario("single-v1")
    before = {n: float(x.get("depart", "")) for n, x in of_edge(scenario).items()}
    for seconds in (300, -300):
        shifted = sound(apply_effects(scenario, [DemandTiming(EDGE, seconds)]))
        after = {n: float(x.get("depart", "")) for n, x in of_edge(shifted).items()}
        assert after == pytest.approx(
            {n: t + seconds for n, t in before.items() if t + seconds > 0}
        )
        others = set(departing(scenario)) - set(before)
        assert others == set(departing(shifted)) - set(after)


FLOWS = (
    '<flow id="a" route="east" begin="0" end="200" vehsPerHour="360"/>'
    '<flow id="b" route="east" begin="0" end="200" period="10"/>'
    '<flow id="c" route="north" begin="0" end="200" period="exp(0.1)"/>'
    '<flow id="d" route="east" begin="0" end="200" probability="0.1"/>'
    '<flow id="e" from="W_C" to="C_E" begin="0" end="200" number="20"/>'
    '<flow id="f" route="north" begin="0" number="20" period="10"/>'
)


def rates(scenario: Scenario) -> dict[str, float]:
    """Expected number of vehicles of every flow."""
    found: dict[str, float] = {}
    for name, flow in departing(scenario).items():
        lasts = float(flow.get("end", "200")) - float(flow.get("begin", "0"))
        if number := flow.get("number"):
            found[name] = float(number)
        elif hourly := flow.get("vehsPerHour"):
            found[name] = lasts * float(hourly) / 3600
        elif probability := flow.get("probability"):
            found[name] = lasts * float(probability)
        else:
            period = flow.get("period", "")
            rate = float(period[4:-1]) if period.startswith("exp") else 1 / float(period)
            found[name] = lasts * rate
    return found


def test_flows_are_scaled(crossing: Crossing) -> None:
    scenario = load_scenario(crossing(vehicles=FLOWS))
    assert rates(scenario) == pytest.approx(dict.fromkeys("abcdef", 20))
    for factor in (0.5, 1.5, 20):
        scaled = rates(sound(apply_effects(scenario, [DemandLevel("*", factor)])))
        assert scaled == pytest.approx(dict.fromkeys("abcdef", 20 * factor))
    east = rates(sound(apply_effects(scenario, [DemandLevel("W_C", 0.5)])))
    assert east == pytest.approx({"a": 10, "b": 10, "c": 20, "d": 10, "e": 10, "f": 20})
    assert not rates(apply_effects(scenario, [DemandLevel("*", 0)]))


@pytest.mark.parametrize(
    ("flow", "vehicles"), [('number="100"', 100), ('end="1000" number="40"', 40)]
)
def test_a_flow_without_begin_or_end_has_those_of_the_episode(
    flow: str, vehicles: int, crossing: Crossing
) -> None:
    scenario = load_scenario(crossing(vehicles=f'<flow id="f" {flow} route="east"/>'))
    settings = scenario.settings.model_copy(update={"begin_s": 500.0, "duration_s": 250.0})
    (found,) = departing(
        apply_effects(replace(scenario, settings=settings), [DemandLevel("*", 0.5)])
    ).values()
    ends = {"number": "750", "end": "1000"}[flow.partition("=")[0]]
    assert (found.get("begin"), found.get("end")) == ("500", ends)
    assert found.get("number") == str(vehicles // 2)


def test_a_surge_cuts_flows_into_parts(crossing: Crossing) -> None:
    scenario = load_scenario(crossing(vehicles=FLOWS))
    cut = sound(apply_effects(scenario, [DemandSurge("W_C", 50, 100, 3)]))
    expected = dict.fromkeys("cf", 20.0)
    for name in "abde":
        expected |= {name: 5, f"{name}+surge": 15, f"{name}+after": 10}
    assert rates(cut) == pytest.approx(expected)
    none = apply_effects(scenario, [DemandSurge("W_C", 50, 100, 0)])
    assert sum(rates(none).values()) == pytest.approx(40 + 4 * 15)


def numbers(scenario: Scenario) -> dict[str, int]:
    return {name: int(flow.get("number", "")) for name, flow in departing(scenario).items()}


SMALL = {
    "number": 'begin="{0}" end="180" number="1"',
    "period": 'begin="{0}" end="180" period="200"',
    "hourly": 'begin="{0}" end="180" vehsPerHour="1"',
}
"""Flows of one vehicle each."""


@pytest.mark.parametrize("kind", SMALL)
def test_many_small_flows_have_the_right_total(kind: str, crossing: Crossing) -> None:
    flows = "".join(
        f'<flow id="f{n}" route="east" {SMALL[kind].format(n / 10)}/>' for n in range(400)
    )
    scenario = load_scenario(crossing(vehicles=flows))
    before: dict[str, int] = {}
    for factor in (0.3, 1.2, 1.7, 2.0):
        found = numbers(sound(apply_effects(scenario, [DemandLevel("*", factor)])))
        assert sum(found.values()) == pytest.approx(400 * factor, abs=bounds(400, factor % 1))
        assert set(found.values()) <= {math.floor(factor), math.ceil(factor)}
        assert all(found[name] >= count for name, count in before.items())
        before = found
    for share in (0.12, 0.5):
        found = numbers(sound(apply_effects(scenario, [HeavyShare(share)])))
        heavy = sum(count for name, count in found.items() if name.endswith("+heavy"))
        assert sum(found.values()) == 400
        assert heavy == pytest.approx(400 * share, abs=bounds(400, share))
    surge = sound(apply_effects(scenario, [DemandSurge("*", 20.05, 200, 1.5)]))
    assert sum(numbers(surge).values()) == pytest.approx(200 + 199 * 1.5, abs=bounds(199, 0.5))
    early = [n for name, n in numbers(surge).items() if float(name[1:].split("+")[0]) / 10 < 20.05]
    assert sum(early) == 201


def test_a_small_flow_turns_whole() -> None:
    scenario = load_scenario("single-v1")
    flows = "".join(
        f'<flow id="f{n}" route="r" begin="{n}" end="1000" number="1"/>' for n in range(400)
    )
    text = f'<routes><route id="r" edges="east1_A1 A1_west1"/>{flows}</routes>'
    made = replace(scenario, routes=(scenario.routes[0].edited(text.encode()),))
    found = numbers(sound(apply_effects(made, [Turning(EDGE, "A1_northA", 0.3)])))
    assert sum(found.values()) == 400
    turned = sum(count for name, count in found.items() if "turning" in name)
    assert turned == pytest.approx(120, abs=bounds(400, 0.3))


def test_a_surge_does_not_move_the_vehicles_outside(crossing: Crossing) -> None:
    flow = '<flow id="f" route="east" begin="3" end="183" number="18"/>'  # 3, 13, ..., 173
    scenario = load_scenario(crossing(vehicles=flow))
    cut = departing(sound(apply_effects(scenario, [DemandSurge("*", 50, 100, 3)])))
    times = {
        name: (part.get("begin"), part.get("end"), part.get("number")) for name, part in cut.items()
    }
    assert times == {
        "f": ("3", "53", "5"),
        "f+surge": ("53", "100", "15"),
        "f+after": ("103", "183", "8"),
    }


def test_flows_that_are_shifted_before_the_begin_lose_their_first_vehicles(
    crossing: Crossing,
) -> None:
    flows = (
        '<flow id="e" route="east" begin="0" end="200" number="20"/>'
        '<flow id="f" route="east" begin="0" number="20" period="10"/>'
        '<flow id="g" route="east" begin="5" end="35" period="10"/>'
    )
    scenario = load_scenario(crossing(vehicles=flows))
    shifted = departing(sound(apply_effects(scenario, [DemandTiming("*", -42)])))
    times = {
        name: (flow.get("begin"), flow.get("end"), flow.get("number"))
        for name, flow in shifted.items()
    }
    # 20 vehicles from -42 s, 10 s apart: five of them before the start
    assert times == {"e": ("8", "158", "15"), "f": ("8", "158", "15")}


def test_what_departs_before_the_begin_is_shifted_into_the_scenario_by_nobody(
    crossing: Crossing,
) -> None:
    begins = lambda text: f"begin_s = 100\n{text}"  # noqa: E731
    flow = '<flow id="f" route="east" begin="0" end="200" period="10"/>'
    single = "".join(
        f'<vehicle id="v{time}" route="east" depart="{time}"/>' for time in range(0, 200, 10)
    )
    for seconds, expected in ((50, (150, 240, 10)), (-50, (100, 140, 5))):
        effect = DemandTiming("*", seconds)
        cars = apply_effects(load_scenario(crossing(vehicles=single, toml=begins)), [effect])
        times = [float(x.get("depart", "")) for x in departing(sound(cars)).values()]
        present = [time for time in times if time >= 100]
        assert (min(present), max(present), len(present)) == expected
        whole = apply_effects(load_scenario(crossing(vehicles=flow, toml=begins)), [effect])
        (shifted,) = departing(sound(whole)).values()
        number = int(shifted.get("number", ""))
        first = float(shifted.get("begin", ""))
        assert (first, first + 10 * (number - 1), number) == expected


def test_flows_are_shifted(crossing: Crossing) -> None:
    scenario = load_scenario(crossing(vehicles=FLOWS))
    later = departing(sound(apply_effects(scenario, [DemandTiming("W_C", 30)])))
    assert (later["a"].get("begin"), later["a"].get("end")) == ("30", "230")
    earlier = departing(sound(apply_effects(scenario, [DemandTiming("W_C", -30)])))
    assert (earlier["a"].get("begin"), earlier["a"].get("end")) == ("0", "170")


def test_who_stands_on_the_street_is_no_demand() -> None:
    scenario = load_scenario("single-v1")
    blocked = apply_effects(
        scenario, [LaneClosure(f"{EDGE}_0", 600, 900), Parking(f"{EDGE}_1", 20, 60)]
    )
    extra = set(departing(blocked)) - set(departing(scenario))
    assert len(extra) == 1 + 20
    for effect in (DemandLevel("*", 0), DemandSurge(EDGE, 0, 3600, 3), DemandTiming("*", 60)):
        after, before = departing(apply_effects(blocked, [effect])), departing(blocked)
        for name in extra:
            assert ET.tostring(after[name]) == ET.tostring(before[name])
        assert not [name for name in after if name.removesuffix("+1") in extra - {name}]


# --- turns


def turns(scenario: Scenario) -> Counter[str]:
    """Where the vehicles that come from EDGE go."""
    return Counter(
        edges(item)[1] for item in departing(scenario).values() if edges(item)[0] == EDGE
    )


def test_a_share_turns_otherwise() -> None:
    scenario = load_scenario("single-v1")
    before, ways = turns(scenario), {n: edges(x) for n, x in departing(scenario).items()}
    to = "A1_northA"
    others = before.total() - before[to]
    turned: list[set[str]] = []
    for share in (0.0, 0.2, 0.5, 1.0):
        after = sound(apply_effects(scenario, [Turning(EDGE, to, share)]))
        assert len(departing(after)) == len(departing(scenario))
        assert turns(after).total() == before.total()
        gained = turns(after)[to] - before[to]
        assert gained == pytest.approx(others * share, abs=bounds(others, share))
        turned.append({n for n, x in departing(after).items() if edges(x) != ways[n]})
        assert len(turned[-1]) == gained
    assert all(a < b for a, b in pairwise(turned))


def test_those_who_turn_go_on_like_others() -> None:
    """At the first intersection of an arterial, vehicles go on to the same places as others."""
    scenario = load_scenario("arterial1x5-v1")
    before = {name: tuple(edges(item)) for name, item in departing(scenario).items()}
    ways = set(before.values())
    pair, tails = next(
        (pair, found)
        for pair in sorted({p for way in ways for p in pairwise(way)})
        if len(found := {way[way.index(pair[0]) + 1 :] for way in ways if pair in pairwise(way)})
        > 3
        and any(pair[0] in way[:-1] and pair not in pairwise(way) for way in ways)
    )
    after = sound(apply_effects(scenario, [Turning(*pair, 0.5)]))
    now = {name: tuple(edges(item)) for name, item in departing(after).items()}
    turned = [name for name, way in now.items() if way != before[name]]
    assert turned
    for name in turned:
        way, old = now[name], before[name]
        place = old.index(pair[0])
        assert way[: place + 1] == old[: place + 1]
        assert way[place + 1 :] in tails


def test_where_nobody_turned_they_leave_the_network() -> None:
    scenario = load_scenario("single-v1")
    to = "A1_northA"
    elsewhere = apply_effects(scenario, [Turning(EDGE, "A1_southA", 1)])
    assert not turns(elsewhere)[to]
    back = sound(apply_effects(elsewhere, [Turning(EDGE, to, 0.5)]))
    assert turns(back)[to] > 20


@pytest.mark.parametrize(
    ("effects", "parts"),
    [
        ([HeavyShare(0.1), HeavyShare(0.2)], 3),
        ([Turning("east1_A1", "A1_southA", 0.3), Turning("east1_A1", "A1_northA", 0.3)], 4),
    ],
)
def test_a_flow_can_be_parted_twice(effects: list[Effect], parts: int) -> None:
    scenario = load_scenario("single-v1")
    text = (
        '<routes><route id="r" edges="east1_A1 A1_west1"/>'
        '<flow id="f" route="r" begin="0" number="100" end="1000"/></routes>'
    )
    routes = Document(scenario.routes[0].name, None, text.encode())
    twice = sound(apply_effects(replace(scenario, routes=(routes,)), effects))
    assert sum(numbers(twice).values()) == 100 and len(numbers(twice)) == parts


def test_flows_and_trips_turn_too() -> None:
    scenario = load_scenario("single-v1")
    routes = scenario.routes[0]
    text = (
        '<routes><route id="r" edges="east1_A1 A1_west1"/>'
        '<flow id="f" route="r" begin="0" end="1000" period="10"/>'
        + "".join(
            f'<trip id="t{n}" from="east1_A1" to="A1_west1" depart="{n}" arrivalLane="0"/>'
            for n in range(100)
        )
        + "</routes>"
    )
    made = replace(scenario, routes=(routes.edited(text.encode()),))
    found = departing(sound(apply_effects(made, [Turning(EDGE, "A1_northA", 0.25)])))
    assert {name: found[name].get("number") for name in ("f", "f+turning")} == {
        "f": "75",
        "f+turning": "25",
    }
    assert edges(found["f+turning"]) == [EDGE, "A1_northA"]
    moved = [item for item in found.values() if item.tag == "vehicle"]
    assert len(moved) == pytest.approx(25, abs=18)
    assert all(edges(item) == [EDGE, "A1_northA"] for item in moved)
    assert all("to" not in item.attrib and "arrivalLane" not in item.attrib for item in moved)


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        (DemandLevel("east_A1", 2), r"unknown edge 'east_A1'\. Did you mean 'east1_A1'"),
        (DemandSurge("x", 0, 1, 2), r"unknown edge 'x'.*Known: .*east1_A1.*'demand_surge' names"),
        (DemandTiming("x", 1), "unknown edge 'x'"),
        (Turning("x", EDGE, 0.1), "unknown edge 'x'"),
        (Turning(EDGE, "x", 0.1), "unknown edge 'x'"),
        (
            Turning(EDGE, "west1_A1", 0.1),
            "unknown edge behind 'east1_A1': 'west1_A1'.*Known: .*A1_northA",
        ),
    ],
)
def test_unknown_edges(effect: DemandLevel, message: str) -> None:
    with pytest.raises(UnknownNameError, match=message):
        effect.apply(load_scenario("single-v1"))


def test_a_number_that_is_none_is_told_with_the_effect() -> None:
    flow = '<flow id="f" begin="0" end="900" vehsPerHour="many" from="a" to="b"/>'
    routes = f"<routes>{flow}</routes>"
    scenario = load_scenario("single-v1")
    scenario = replace(scenario, routes=(Document("d.rou.xml", None, routes.encode()),))
    with pytest.raises(ScenarioError, match=r"demand_level=.*cannot be applied, because a value"):
        apply_effects(scenario, parse_domain("demand_level=*,1.2"))


def test_a_flow_that_draws_its_way_cannot_turn() -> None:
    """It used to be passed over, so that the share was not met."""
    scenario = load_scenario("single-v1")
    text = (
        '<routes><routeDistribution id="rd">'
        '<route id="a" edges="east1_A1 A1_west1"/><route id="b" edges="east1_A1 A1_southA"/>'
        '</routeDistribution><flow id="f" route="rd" begin="0" end="1000" period="10"/></routes>'
    )
    made = replace(scenario, routes=(scenario.routes[0].edited(text.encode()),))
    with pytest.raises(ScenarioError, match="flow 'f' draws its way from 'rd'; give it a route"):
        apply_effects(made, [Turning(EDGE, "A1_northA", 0.25)])


# --- demand of another form


def with_routes(text: str, begin_s: float = 0.0, duration_s: float = 3600.0) -> Scenario:
    """single-v1 with these vehicles, trips and flows."""
    scenario = load_scenario("single-v1")
    changes = {"begin_s": begin_s, "duration_s": duration_s}
    return replace(
        scenario,
        settings=scenario.settings.model_copy(update=changes),
        routes=(Document("own.rou.xml", None, f"<routes>{text}</routes>".encode()),),
    )


def vehicles(departs: list[float]) -> str:
    route = '<route edges="west1_A1 A1_east1"/>'
    return "".join(
        f'<vehicle id="v{n}" depart="{t:g}">{route}</vehicle>' for n, t in enumerate(departs)
    )


@pytest.mark.parametrize("effect", [DemandLevel("*", 2.0), DemandSurge("*", 0.0, 7200.0, 2.0)])
def test_vehicles_from_before_the_episode_have_no_twins_in_it(effect: Effect) -> None:
    scenario = with_routes(vehicles([10.0 * n for n in range(720)]), begin_s=3600.0)
    grown = apply_effects(scenario, [effect])
    times = [float(item.get("depart", "")) for item in departing(grown).values()]
    assert sum(3600 <= time < 7200 for time in times) == 720
    assert times.count(3600.0) <= 2


def test_a_short_surge_stays_in_its_window() -> None:
    scenario = with_routes(vehicles([600 + 0.1 * n for n in range(100)]))
    grown = apply_effects(scenario, [DemandSurge("*", 600.0, 610.0, 2.0)])
    times = [float(item.get("depart", "")) for item in departing(grown).values()]
    assert len(times) == 200 and min(times) >= 600 and max(times) < 610


@pytest.mark.parametrize("kind", ["Taz", "Junction", "XY", "LonLat"])
def test_demand_that_starts_at_no_edge_has_no_first_edge(kind: str) -> None:
    scenario = with_routes(f'<trip id="t" depart="1" from{kind}="a" to{kind}="b"/>')
    with pytest.raises(OptionError, match=f"trip 't' starts at from{kind} = 'a'"):
        apply_effects(scenario, [DemandLevel(EDGE, 2.0)])
    with pytest.raises(ScenarioError, match=f"trip 't' has from{kind} = 'a'"):
        apply_effects(scenario, [Turning(EDGE, "A1_northA", 1)])
    assert len(departing(apply_effects(scenario, [DemandLevel("*", 2.0)]))) == 2


def test_parking_rounds_half_a_vehicle_up() -> None:
    scenario = with_routes(vehicles([1.0]), duration_s=1800.0)
    for per_hour, number in ((1.0, 1), (3.0, 2), (0.9, 0)):
        parked = apply_effects(scenario, [Parking("west1_A1_0", per_hour, 60.0)])
        text = b"".join(document.read() for document in (*parked.routes, *parked.additional))
        assert text.count(b'<vehicle id="parking.') == number


def test_two_effects_on_a_lane_park_at_different_times() -> None:
    scenario = with_routes(vehicles([1.0]))
    once, twice = (
        {tag.attributes["depart"] for document in apply_effects(scenario, effects).routes
         for tag in document.scan() if tag.name == "vehicle" and "parking" in tag.attributes["id"]}
        for effects in ([Parking("west1_A1_0", 4, 60)],
                        [Parking("west1_A1_0", 4, 60), Parking("west1_A1_0", 4, 120)])
    )  # fmt: skip
    assert len(once) == 4 and len(twice) == 8 and once < twice


def test_a_distribution_of_its_own_is_no_way_to_turn_from() -> None:
    inner = (
        '<vehicle id="v" depart="1"><routeDistribution>'
        f'<route edges="{EDGE} A1_southA" probability="1"/></routeDistribution></vehicle>'
    )
    with pytest.raises(ScenarioError, match="'v' draws its way from 'a distribution of its own'"):
        apply_effects(with_routes(inner), [Turning(EDGE, "A1_northA", 1.0)])
    grown = apply_effects(with_routes(inner), [DemandLevel(EDGE, 2.0)])  # it begins there anyway
    assert len(departing(grown)) == 2


def test_a_truck_is_no_faster_than_the_car_it_replaces() -> None:
    types = '<vType id="slow" maxSpeed="8"/><vType id="car" maxSpeed="55.55"/>'
    both = '<flow id="{0}" type="{0}" begin="0" end="10" number="5" from="west1_A1" to="A1_east1"/>'
    scenario = with_routes(types + both.format("slow") + both.format("car"))
    changed = apply_effects(scenario, [HeavyShare(1.0)])
    speeds = {
        item.get("id"): item.get("maxSpeed")
        for document in (*changed.additional, *changed.routes)
        for item in document.parse().iter("vType")
    }
    assert speeds["heavy.slow"] == "8" and speeds["heavy.car"] == "36.11"


def test_trucks_of_a_distribution_are_those_of_its_cars() -> None:
    types = (
        '<vTypeDistribution id="mix"><vType id="quick" probability="0.1"/>'
        '<vType id="slow" maxSpeed="5" probability="0.9"/></vTypeDistribution>'
    )
    trip = '<trip id="t" type="mix" depart="1" from="west1_A1" to="A1_east1"/>'
    changed = apply_effects(with_routes(types + trip), [HeavyShare(1.0)])
    parts = [document.parse() for document in (*changed.routes, *changed.additional)]
    (mix,) = (x for part in parts for x in part.iter("vTypeDistribution"))
    shares = zip(mix.get("vTypes", "").split(), mix.get("probabilities", "").split(), strict=True)
    assert {name: float(share) for name, share in shares} == {"heavy.quick": 0.1, "heavy.slow": 0.9}
    speeds = {x.get("id"): x.get("maxSpeed") for part in parts for x in part.iter("vType")}
    assert speeds["heavy.slow"] == "5" and speeds["heavy.quick"] == "36.11"


@pytest.mark.parametrize("inside", [True, False])
def test_a_turned_vehicle_keeps_its_stops_before_the_turn(inside: bool) -> None:
    stops = f'<stop edge="{EDGE}" endPos="20" duration="30"/><stop lane="A1_west1_0" duration="9"/>'
    route = f'<route edges="{EDGE} A1_west1">{stops if inside else ""}</route>'
    demand = (
        f'<routes><vehicle id="a" depart="1">{route}{"" if inside else stops}</vehicle></routes>'
    )
    scenario = load_scenario("single-v1")
    scenario = replace(scenario, routes=(scenario.routes[0].edited(demand.encode()),))
    turned = departing(sound(apply_effects(scenario, [Turning(EDGE, "A1_northA", 1)])))["a"]
    assert edges(turned) == [EDGE, "A1_northA"]
    assert [stop.get("edge") for stop in turned.iter("stop")] == [EDGE]
    assert [child.tag for child in turned] == ["route", "stop"]


@pytest.mark.parametrize("tag", ["vehicle", "flow"])
def test_a_turned_vehicle_keeps_the_stops_of_its_named_route(tag: str) -> None:
    """There they count from the departure, in the vehicle itself from the start of the clock."""
    stops = '<stop lane="east1_A1_0" until="90"/><stop lane="A1_west1_0" duration="9"/>'
    route = f'<route id="r" edges="{EDGE} A1_west1">{stops}</route>'
    when = 'depart="100"' if tag == "vehicle" else 'begin="100" end="160" number="1"'
    scenario = with_routes(route + f'<{tag} id="a" route="r" {when}/>')
    (turned,) = departing(apply_effects(scenario, [Turning(EDGE, "A1_northA", 1)])).values()
    assert [(x.get("lane"), float(x.get("until", ""))) for x in turned.iter("stop")] == [
        ("east1_A1_0", 190.0)
    ]
    first = with_routes(route + '<vehicle id="a" route="r" depart="begin"/>', begin_s=3600.0)
    (turned,) = departing(apply_effects(first, [Turning(EDGE, "A1_northA", 1)])).values()
    assert [x.get("until") for x in turned.iter("stop")] == ["3690"]
    chance = with_routes(route + '<flow id="a" begin="0" end="9" probability="0.1" route="r"/>')
    with pytest.raises(ScenarioError, match="flow 'a' departs by chance, and its route 'r' has"):
        apply_effects(chance, [Turning(EDGE, "A1_northA", 1)])


@pytest.mark.parametrize("inside", [True, False])
@pytest.mark.parametrize(
    "effect",
    [DemandTiming("*", 40), DemandTiming("*", -40), DemandSurge("*", 150, 250, 2)],
    ids=str,
)
def test_stops_last_as_long_when_departures_move(effect: Effect, inside: bool) -> None:
    stop = '<stop lane="west1_A1_0" endPos="50" until="{}"/>'
    route = '<route edges="west1_A1 A1_east1">{}</route>{}'
    waits = [
        route.format(*((stop.format(until), "") if inside else ("", stop.format(until))))
        for until in (180, 190, 190)
    ]
    scenario = with_routes(
        f'<flow id="random" begin="90" end="400" probability="0.05">{waits[0]}</flow>'
        f'<flow id="regular" begin="100" end="400" period="30">{waits[1]}</flow>'
        f'<vehicle id="single" depart="200">{route.format(stop.format(290), "")}</vehicle>'
    )
    found = departing(apply_effects(scenario, [effect]))
    assert len(found) > 3 or isinstance(effect, DemandTiming)
    shift = effect.seconds if isinstance(effect, DemandTiming) else 0.0
    for name, item in found.items():
        begin = float(item.get("begin") or item.get("depart") or "")
        (until,) = (float(x.get("until", "")) for x in item.iter("stop"))
        if name.startswith("random"):  # SUMO reads these as times of the clock
            assert until == 180.0 + shift
        else:
            assert until - begin == pytest.approx(90.0, abs=0.01), name


def test_laps_of_a_turned_vehicle_count() -> None:
    laps = ["A1_A2", "A2_B2", "B2_B1", "B1_A1"]
    demand = (
        f'<routes><vehicle id="a" depart="1"><route edges="{" ".join(laps)}" repeat="1"/></vehicle>'
        "</routes>"
    )
    scenario = load_scenario("grid2x2-v1")
    scenario = replace(scenario, routes=(scenario.routes[0].edited(demand.encode()),))
    turned = departing(sound(apply_effects(scenario, [Turning("B1_A1", "A1_west1", 1)])))["a"]
    assert edges(turned) == [*laps, "A1_west1"]


@pytest.mark.parametrize("effect", [DemandTiming("*", 30), DemandTiming("*", -30)])
def test_who_departs_at_once_does_so_at_another_time(effect: Effect, crossing: Crossing) -> None:
    """SUMO refuses a flow that ends before it begins."""
    burst = '<flow id="b" begin="100" end="100" number="5" route="east"/>'
    (flow,) = departing(apply_effects(load_scenario(crossing(vehicles=burst)), [effect])).values()
    at = "130" if effect == DemandTiming("*", 30) else "70"
    assert (flow.get("begin"), flow.get("end"), flow.get("number")) == (at, at, "5")


def test_more_of_a_sparse_flow_departs_before_its_end() -> None:
    flows = "".join(
        f'<flow id="f{k}" begin="{900 * k}" end="{900 * (k + 1)}" vehsPerHour="1" '
        'from="west1_A1" to="A1_east1"/>'
        for k in range(4)
    )
    doubled = demand_as_vehicles(apply_effects(with_routes(flows), [DemandLevel("*", 2.0)]))
    quarters = Counter(int(float(x.get("depart", ""))) // 900 for x in departing(doubled).values())
    assert quarters == {0: 2, 1: 2, 2: 2, 3: 2}
    one = with_routes(flows.split("/>")[0] + "/>")
    for effects in (
        [DemandSurge("*", 0.0, 1800.0, 2.0)],
        [DemandTiming("*", 10.0), DemandLevel("*", 2.0)],
        [Turning("west1_A1", "A1_northA", 1.0), DemandLevel("*", 2.0)],
    ):
        twice = demand_as_vehicles(apply_effects(one, effects))
        times = [float(x.get("depart", "")) for x in departing(twice).values()]
        assert len(times) == 2 and max(times) < 910, effects


def test_the_period_of_a_flow_may_be_a_time_of_day(crossing: Crossing) -> None:
    flow = '<flow id="f" begin="0" end="0:01:40" period="0:00:10" route="east"/>'
    scenario = load_scenario(crossing(vehicles=flow))
    assert numbers(apply_effects(scenario, [DemandLevel("*", 2.0)])) == {"f": 20}


def test_a_surge_has_ended_where_a_burst_begins(crossing: Crossing) -> None:
    burst = '<flow id="b" begin="100" end="100" number="5" route="east"/>'
    scenario = load_scenario(crossing(vehicles=burst))
    for window, number in (((50, 100), 5), ((100, 150), 10)):
        changed = apply_effects(scenario, [DemandSurge("*", *window, 2)])
        assert sum(numbers(changed).values()) == number


def test_a_demand_that_an_effect_took_away_says_so(crossing: Crossing) -> None:
    with pytest.raises(ScenarioError, match=r"between 0 s and 200 s after demand_level=\*,0; "):
        parallel_env(crossing(), "demand_level=*,0")
