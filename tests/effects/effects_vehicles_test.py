"""Effects on drivers and the fleet, read back from the running simulation."""

from __future__ import annotations

import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import fmean, pstdev

import libsumo
import pytest
import sumo

from ugat_marl.effects import (
    Acceleration,
    DesiredSpeed,
    DriverModel,
    Effect,
    GapAcceptance,
    Headway,
    HeavyShare,
    Imperfection,
    LaneDiscipline,
    MinGap,
    ReactionStep,
    RedRunning,
    SpeedSpread,
    StartupDelay,
    YellowRunning,
    apply_effects,
    load_scenario,
    parse_domain,
    scenario_in_domain,
)
from ugat_marl.effects.vehicles import DRIVER_MODELS
from ugat_marl.errors import UnknownNameError
from ugat_marl.scenarios import Scenario, SpeedFactors
from ugat_marl.simulation import LibsumoSimulator, launch_of

Crossing = Callable[..., Path]
Question = Callable[[str], object] | str
"""What SUMO tells of a vehicle; or an attribute it does not tell, read from the vehicle's type."""

MIX = (
    '<vType id="r1" accel="2"/><vType id="r2" vClass="truck" speedFactor="0.9"/>'
    '<vTypeDistribution id="mix" vTypes="r1 r2" probabilities="0.5 0.5"/>'
)
CARS = "".join(
    f'<vehicle id="v{n}" type="car" route="{road}" depart="{n}"/>'
    for n, road in enumerate(("north", "east") * 6)
)
EVERY_KIND = (
    CARS
    + '<vehicle id="d" route="north" depart="12"/>'
    + '<vehicle id="m" type="mix" route="east" depart="13"/>'
    + '<flow id="f" type="mix" route="east" begin="14" end="44" period="5"/>'
    + '<trip id="t" type="car" from="W_C" to="C_E" depart="45"/>'
)


@pytest.fixture
def simulator() -> Iterator[LibsumoSimulator]:
    made = LibsumoSimulator()
    yield made
    made.close()


def asked(
    simulator: LibsumoSimulator,
    scenario: Scenario,
    own: Path,
    question: Question,
) -> dict[str, object]:
    """The answer of every vehicle of the first minute."""
    own.mkdir()
    ask = question if callable(question) else written(scenario, question)
    simulator.start(launch_of(scenario, 1, own, ()))
    answers: dict[str, object] = {}
    for _ in range(60):
        simulator.advance(1, {})
        answers |= {name: ask(name) for name in libsumo.vehicle.getIDList()}
    return answers


def written(scenario: Scenario, attribute: str) -> Callable[[str], object]:
    """Parameters of junctions are not told; they stand in every type in use."""
    documents = (*scenario.additional, *scenario.routes)
    types = {
        item.get("id", ""): float(item.get(attribute, "nan"))
        for document in documents
        for item in document.parse().iter("vType")
    }
    return lambda name: types[libsumo.vehicle.getTypeID(name)]


def parameter(key: str) -> Callable[[str], object]:
    return lambda name: float(libsumo.vehicle.getParameter(name, key))


ATTRIBUTES: list[tuple[Effect, Question]] = [
    (Headway(2.2), libsumo.vehicle.getTau),
    (MinGap(3.5), libsumo.vehicle.getMinGap),
    (Imperfection(0.85), libsumo.vehicle.getImperfection),
    (ReactionStep(2.0), libsumo.vehicle.getActionStepLength),
    (YellowRunning(1.5), "jmDriveAfterYellowTime"),
    (RedRunning(2.5), "jmDriveAfterRedTime"),
    (GapAcceptance(2.25), "jmTimegapMinor"),
    (LaneDiscipline(0.3), parameter("laneChangeModel.lcStrategic")),
]


@pytest.mark.parametrize(("effect", "question"), ATTRIBUTES, ids=lambda x: getattr(x, "name", ""))
def test_attributes_reach_every_vehicle(
    effect: Effect,
    question: Question,
    simulator: LibsumoSimulator,
    crossing: Crossing,
    tmp_path: Path,
) -> None:
    scenario = load_scenario(crossing(vehicles=EVERY_KIND, types=MIX))
    answers = asked(simulator, apply_effects(scenario, [effect]), tmp_path / "own", question)
    assert len(answers) == 12 + 2 + 6 + 1
    assert set(answers.values()) == {next(iter(vars(effect).values()))}


def all_of(questions: list[Callable[[str], object]]) -> Callable[[str], object]:
    return lambda name: tuple(question(name) for question in questions)


def test_all_of_them_at_once_in_any_order(
    simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    scenario = load_scenario(crossing(vehicles=EVERY_KIND, types=MIX))
    effects = [effect for effect, _ in ATTRIBUTES]
    for place, order in enumerate((effects, effects[::-1])):
        changed = apply_effects(scenario, order)
        questions = [q if callable(q) else written(changed, q) for _, q in ATTRIBUTES]
        own = tmp_path / str(place)
        answers = asked(simulator, changed, own, all_of(questions))
        assert set(answers.values()) == {tuple(next(iter(vars(x).values())) for x in effects)}


def last_crossing(scenario: Scenario, simulator: LibsumoSimulator, own: Path) -> float:
    """Cars come every second to a light that turns yellow at 60 s and red at 63 s."""
    own.mkdir()
    simulator.start(launch_of(scenario, 1, own, ("C_E_0",)))
    simulator.advance(60, {"C": [(60.0, "rG")]})
    latest = 60.0
    for second in range(60, 80):
        simulator.advance(1, {"C": [(1.0, "ry" if second < 63 else "rr")]})
        if any(name.startswith(":C") for name in map(libsumo.vehicle.getRoadID, cars())):
            latest = second
    return latest


@pytest.mark.parametrize(
    "effects",
    [
        [], [Headway(0.2)], [ReactionStep(2)], [ReactionStep(3), Headway(0.5)],
        [Headway(0.5), ReactionStep(3)], [StartupDelay(3)], [Imperfection(1)],
        *([DriverModel(model)] for model in DRIVER_MODELS),
    ],
    ids=lambda effects: "+".join(map(str, effects)),
)  # fmt: skip
def test_nobody_runs_a_red_light_or_into_another(
    effects: list[Effect], simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    """SUMO's drivers do, if they decide less often than their time gap allows."""
    stream = '<flow id="f" route="east" begin="0" end="190" period="4"/>'
    scenario = apply_effects(load_scenario(crossing(vehicles=stream)), effects)
    own = tmp_path / "own"
    own.mkdir()
    simulator.start(launch_of(scenario, 1, own, ()))
    before: set[str] = set()
    for second in range(190):
        green = second % 50 >= 40
        simulator.advance(1, {"C": [(1.0, "rG" if green else "ry" if second % 50 < 3 else "rr")]})
        assert not libsumo.simulation.getCollidingVehiclesIDList()
        inside = {name for name in cars() if libsumo.vehicle.getRoadID(name).startswith(":C")}
        assert green or second % 50 < 5 or not inside - before
        before = inside


def test_time_gaps_and_reaction_steps_in_any_order(crossing: Crossing) -> None:
    scenario = load_scenario(crossing(vehicles=EVERY_KIND, types=MIX))
    for gap, reaction, expected in ((0.5, 2, 2), (3, 2, 3), (0.5, 1, 1), (1.4, 1, 1.4)):
        for order in (
            [Headway(gap), ReactionStep(reaction)],
            [ReactionStep(reaction), Headway(gap)],
        ):
            changed = apply_effects(scenario, order)
            documents = (*changed.additional, *changed.routes)
            types = [item for file in documents for item in file.parse().iter("vType")]
            assert {(x.get("tau"), x.get("actionStepLength")) for x in types} == {
                (f"{expected:g}", f"{reaction:g}")
            }


def cars() -> list[str]:
    return list(libsumo.vehicle.getIDList())


def test_drivers_run_yellow_and_red(
    simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    stream = (
        '<flow id="f" type="car" route="east" begin="0" end="90" period="2.5" departSpeed="10"/>'
    )
    scenario = load_scenario(crossing(vehicles=stream))
    seen = [
        last_crossing(apply_effects(scenario, effects), simulator, tmp_path / str(place))
        for place, effects in enumerate(([], [YellowRunning(3)], [YellowRunning(3), RedRunning(4)]))
    ]
    assert seen[0] < seen[1] < seen[2]


# --- desired speeds

CLASSES = (
    "passenger", "truck", "bus", "delivery", "taxi", "bicycle", "motorcycle", "moped", "trailer",
    "coach", "emergency", "evehicle", "hov", "private", "custom1", "army", "vip", "authority",
    "ignoring", "tram", "rail", "rail_urban", "rail_electric", "rail_fast", "subway", "cable_car",
    "ship", "aircraft", "drone", "pedestrian", "wheelchair", "container", "scooter",
)  # fmt: skip
WRITTEN = {
    "number": 'speedFactor="1.2"',
    "number and deviation": 'speedFactor="1.2" speedDev="0.05"',
    "normal": 'speedFactor="norm(1.1,0.2)"',
    "cut": 'speedFactor="normc(1.1,0.2,0.5,1.5)"',
    "mean in words": 'speedFactor="normc(1.1)"',
    "without limits": 'speedFactor="normc(1.1,0.2)"',
    "cut and deviation": 'speedFactor="normc(1.1,0.2,0.5,1.5)" speedDev="0.03"',
    "deviation": 'speedDev="0.02"',
    "truck": 'vClass="truck" speedFactor="0.9"',
} | {name: f'vClass="{name}"' for name in CLASSES}


@pytest.mark.parametrize("option", [None, 0.07])
def test_types_are_read_as_sumo_reads_them(
    option: float | None, simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    types = "".join(
        f'<vType id="{name.replace(" ", "_")}" {text}/>' for name, text in WRITTEN.items()
    )
    settings = f'[sumo]\n"default.speeddev" = "{option}"\n'
    toml = (lambda text: text + settings) if option is not None else None
    scenario = load_scenario(crossing(vehicles=CARS, types=types, toml=toml))
    spread = apply_effects(scenario, [DesiredSpeed(1.0)])
    for place, world in enumerate((scenario, spread)):
        own = tmp_path / f"own{place}"
        own.mkdir()
        simulator.start(launch_of(world, 1, own, ()))
        for item in scenario.routes[0].parse().iter("vType"):
            name = item.get("id", "")
            speeds = SpeedFactors.of(item.attrib, scenario.settings.sumo)
            api = libsumo.vehicletype
            assert api.getSpeedFactor(name) == pytest.approx(speeds.mean), name
            assert api.getSpeedDeviation(name) == pytest.approx(speeds.deviation), name


def factors(simulator: LibsumoSimulator, scenario: Scenario, own: Path) -> dict[str, float]:
    found = asked(simulator, scenario, own, libsumo.vehicle.getSpeedFactor)
    return {name: float(str(value)) for name, value in found.items()}


SINGLE = "".join(
    f'<vehicle id="v{n}" type="{kind}" route="{road}" depart="{2 * n}" speedFactor="{factor}"/>'
    for n, (road, kind, factor) in enumerate(
        [("north", "a", 1.1), ("east", "a", 0.95), ("north", "b", 0.8), ("east", "b", 1.0)]
    )
)
KINDS = (
    '<vType id="a" speedFactor="1" speedDev="0.1"/><vType id="b" speedFactor="0.9" speedDev="0"/>'
)


def test_desired_speeds_of_single_vehicles(
    simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    scenario = load_scenario(crossing(vehicles=SINGLE, types=KINDS))
    slow = factors(simulator, apply_effects(scenario, [DesiredSpeed(0.8)]), tmp_path / "slow")
    assert slow == pytest.approx({"v0": 0.88, "v1": 0.76, "v2": 0.64, "v3": 0.8})
    wide = factors(simulator, apply_effects(scenario, [SpeedSpread(0.2)]), tmp_path / "wide")
    assert [wide["v0"], wide["v1"]] == pytest.approx([1.2, 0.9])  # twice as far from the mean of a
    assert wide["v2"] != wide["v3"]  # b had no spread at all: by a hash of the id
    none = factors(simulator, apply_effects(scenario, [SpeedSpread(0)]), tmp_path / "none")
    assert none == pytest.approx({"v0": 1, "v1": 1, "v2": 0.9, "v3": 0.9})


def test_a_factor_of_desired_speeds_scales_all_numbers_of_a_type(crossing: Crossing) -> None:
    types = '<vType id="cut" speedFactor="normc(1.1,0.2,0.5,1.5)"/>'
    scenario = apply_effects(
        load_scenario(crossing(vehicles=CARS, types=types)), [DesiredSpeed(0.5)]
    )
    (kind,) = [x for x in scenario.routes[0].parse().iter("vType") if x.get("id") == "cut"]
    found = SpeedFactors.of(kind.attrib, scenario.settings.sumo)
    expected = (0.55, 0.1, 0.25, 0.75)
    assert (found.mean, found.deviation, found.least, found.greatest) == pytest.approx(expected)


def test_single_vehicles_stay_within_the_limits_of_their_type(crossing: Crossing) -> None:
    types = '<vType id="cut" speedFactor="normc(1,0.1,0.8,1.2)"/>'
    vehicles = "".join(
        f'<vehicle id="v{factor}" type="cut" route="north" depart="1" speedFactor="{factor}"/>'
        for factor in (0.85, 1.0, 1.15)
    )
    scenario = load_scenario(crossing(vehicles=vehicles, types=types))
    changed = apply_effects(scenario, [SpeedSpread(0.3)])
    speeds = [x.get("speedFactor") for x in changed.routes[0].parse().iter("vehicle")]
    assert speeds == ["0.8", "1", "1.2"]


def test_desired_speeds_of_types(
    simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    many = "".join(
        f'<vehicle id="v{n}" route="{("north", "east")[n % 2]}" depart="{n / 8}"/>'
        for n in range(400)
    )
    scenario = load_scenario(crossing(vehicles=many))
    drawn = {
        name: list(factors(simulator, scenario_in_domain(scenario, text), tmp_path / name).values())
        for name, text in {
            "plain": "sim", "slow": "desired_speed=0.7", "wide": "speed_spread=0.2",
            "both": "speed_spread=0.2+desired_speed=0.7", "even": "speed_spread=0",
        }.items()
    }  # fmt: skip
    moments = {name: (fmean(x), pstdev(x)) for name, x in drawn.items()}
    count = min(map(len, drawn.values()))
    assert count > 20
    slack = 4 * 0.2 / count**0.5
    expected = {
        "plain": (1, 0.1), "slow": (0.7, 0.07), "wide": (1, 0.2), "both": (0.7, 0.14),
        "even": (1, 0),
    }  # fmt: skip
    for name, (mean, deviation) in expected.items():
        assert moments[name] == pytest.approx((mean, deviation), abs=slack), name
    assert set(drawn["even"]) == {1.0}


def test_a_model_inside_of_a_type_does_not_overrule_an_effect(crossing: Crossing) -> None:
    old = '<vType id="old" tau="1"><carFollowing-IDM tau="0.9" accel="2.2"/></vType>'
    scenario = apply_effects(
        load_scenario(crossing(vehicles=CARS, types=old)), [Headway(1.6), Acceleration(1.5)]
    )
    (kind,) = [x for x in scenario.routes[0].parse().iter("vType") if x.get("id") == "old"]
    assert [x.get("tau") for x in kind.iter()] == ["1.6", "1.6"]
    assert [x.get("accel") for x in kind.iter()] == ["1.5", "1.5"]


# --- heavy vehicles


def kinds(scenario: Scenario) -> dict[str, str]:
    return {
        item.get("id", ""): item.get("type", "")
        for item in scenario.routes[0].parse()
        if item.tag in ("vehicle", "trip", "flow")
    }


def test_trucks_are_chosen_by_a_hash_and_nested() -> None:
    scenario = load_scenario("single-v1")
    before = kinds(scenario)
    chosen: list[set[str]] = []
    for share in (0.0, 0.1, 0.2, 0.5, 1.0):
        after = kinds(apply_effects(scenario, [HeavyShare(share)]))
        assert after.keys() == before.keys()
        trucks = {name for name, kind in after.items() if kind == "heavy.car"}
        assert all(after[name] == before[name] for name in before.keys() - trucks)
        n = len(before)
        assert len(trucks) == pytest.approx(n * share, abs=4 * (n * share * (1 - share)) ** 0.5)
        chosen.append(trucks)
    assert all(a <= b for a, b in zip(chosen, chosen[1:], strict=False))


def test_trucks_are_long_and_slow_and_else_like_the_cars(
    simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    scenario = load_scenario(crossing(vehicles=EVERY_KIND, types=MIX))

    def nature(name: str) -> object:
        api = libsumo.vehicle
        if api.getTypeID(name) == "r2":
            return "a truck before"
        return tuple(
            round(f(name), 3) for f in (api.getLength, api.getAccel, api.getDecel, api.getTau)
        )

    before = apply_effects(scenario, [Headway(1.5), Acceleration(2), HeavyShare(1)])
    seen = asked(simulator, before, tmp_path / "before", nature)
    assert set(seen.values()) == {(12, 1, 3.5, 1.5), "a truck before"}
    assert len(seen) == 12 + 2 + 6 + 1
    after = apply_effects(scenario, [HeavyShare(1), Headway(1.5), Acceleration(2)])
    seen = asked(simulator, after, tmp_path / "after", nature)
    assert set(seen.values()) == {(12, 2, 3.5, 1.5), "a truck before"}


def test_a_part_of_each_flow_is_heavy(crossing: Crossing) -> None:
    flow = '<flow id="f" route="east" begin="0" end="200" vehsPerHour="720"/>'
    scenario = apply_effects(load_scenario(crossing(vehicles=flow)), [HeavyShare(0.25)])
    found = {
        item.get("id"): (item.get("type"), item.get("number"))
        for item in scenario.routes[0].parse().iter("flow")
    }
    assert found == {"f": (None, "30"), "f+heavy": ("heavy.DEFAULT_VEHTYPE", "10")}


def test_red_running_of_no_second_is_none(crossing: Crossing) -> None:
    """SUMO's drivers never stop at yellow if the attribute is there, even as 0."""
    runs = apply_effects(load_scenario(crossing(vehicles=CARS)), [RedRunning(2.0)])
    for seconds, expected in ((1.0, {"1"}), (0.0, {None})):
        changed = apply_effects(runs, [RedRunning(seconds)])
        kinds_there = [
            x for d in (*changed.additional, *changed.routes) for x in d.parse().iter("vType")
        ]
        assert {kind.get("jmDriveAfterRedTime") for kind in kinds_there} == expected


def test_buses_stay_buses(crossing: Crossing) -> None:
    types = '<vType id="bus" vClass="bus"/>'
    vehicles = '<vehicle id="v" type="bus" route="east" depart="0"/>'
    scenario = load_scenario(crossing(vehicles=vehicles, types=types))
    assert kinds(apply_effects(scenario, [HeavyShare(1)])) == {"v": "bus"}


LISTED = (
    '<vType id="lorry" vClass="truck"/><vType id="van" accel="2"/>'
    '<vTypeDistribution id="fleet" vTypes="lorry van" probabilities="0.25 0.75"/>'
)
NESTED = (
    '<vTypeDistribution id="fleet"><vType id="lorry" vClass="truck" probability="1"/>'
    '<vType id="van" accel="2" probability="3"/></vTypeDistribution>'
)


@pytest.mark.parametrize("types", [LISTED, NESTED], ids=["listed", "nested"])
def test_only_the_cars_of_a_mixed_fleet_become_trucks(
    types: str, simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    scenario = load_scenario(crossing(vehicles=CARS, types=types))
    twice = apply_effects(scenario, [HeavyShare(0.5), HeavyShare(0.5)])
    simulator.start(launch_of(twice, 1, tmp_path / "own", ()))
    drawn: list[str] = []
    for number in range(4000):
        libsumo.vehicle.add(f"x{number}", "north", "fleet", depart="999")
        drawn.append(libsumo.vehicle.getTypeID(f"x{number}"))
    shares = {kind: drawn.count(kind) / len(drawn) for kind in set(drawn)}
    expected = {"lorry": 0.25, "van": 0.75 / 4, "heavy.van": 0.75 * 3 / 4}
    assert shares == pytest.approx(expected, abs=4 * (0.25 / len(drawn)) ** 0.5)
    once, after = (
        list(kinds(x).values()) for x in (apply_effects(scenario, [HeavyShare(0.5)]), twice)
    )
    assert all(a == b for a, b in zip(once, after, strict=True) if a.startswith("heavy"))
    assert once != after, "of the cars that are left, half become trucks too"


def test_a_headway_is_no_shorter_than_the_usual_time_between_decisions(crossing: Crossing) -> None:
    option = '[sumo]\n"default.action-step-length" = "2"\n'
    types = '<vType id="quick" actionStepLength="1"/>'
    scenario = load_scenario(crossing(vehicles=CARS, types=types, toml=lambda text: text + option))
    driven = apply_effects(scenario, [Headway(0.5)])
    taus = {x.get("id"): x.get("tau") for x in driven.routes[0].parse().iter("vType")}
    assert taus == {"car": "2", "quick": "1"}


# --- driver models


@pytest.mark.parametrize("model", DRIVER_MODELS)
def test_every_driver_model_drives_with_parameters_of_others(
    model: str, crossing: Crossing, tmp_path: Path
) -> None:
    old = '<vType id="old"><carFollowing-Krauss accel="2.2" sigma="0.3"/></vType>'
    vehicles = EVERY_KIND + '<vehicle id="o" type="old" route="north" depart="46"/>'
    effects = [*(effect for effect, _ in ATTRIBUTES[:3]), DriverModel(model), Acceleration(1.5)]
    scenario = apply_effects(load_scenario(crossing(vehicles=vehicles, types=MIX + old)), effects)
    for item in (
        x for d in (*scenario.additional, *scenario.routes) for x in d.parse().iter("vType")
    ):
        assert (item.get("carFollowModel"), item.get("accel"), len(item)) == (model, "1.5", 0)
    launch = launch_of(scenario, 1, tmp_path / "own", ())
    launch.write()
    program = Path(sumo.SUMO_HOME) / "bin" / "sumo"
    subprocess.run([program, *launch.arguments, "--end", "150"], check=True, capture_output=True)
    trips = ET.parse(tmp_path / "own" / "trips.xml").getroot()
    assert len([x for x in trips if float(x.get("depart", "-1")) >= 0]) >= 12


def test_a_model_that_does_not_exist() -> None:
    assert DriverModel("idm") == DriverModel("IDM")
    with pytest.raises(UnknownNameError, match=r"model of effect 'driver_model': 'IDN'.*'IDM'"):
        DriverModel("IDN")


def test_trucks_are_no_better_than_the_cars_of_their_weather() -> None:
    scenario = apply_effects(load_scenario("single-v1"), [*parse_domain("V4"), HeavyShare(0.5)])
    trucks = [
        kind
        for document in (*scenario.additional, *scenario.routes)
        for kind in document.parse().iter("vType")
        if kind.get("id", "").startswith("heavy.")
    ]
    assert trucks
    assert {(kind.get("accel"), kind.get("decel")) for kind in trucks} == {("0.5", "1.5")}
