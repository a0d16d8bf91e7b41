"""Effects: the paper's settings, and that they reach every vehicle of the running simulation."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import libsumo
import numpy as np
import pytest
import sumo

from ugat_marl import parallel_env
from ugat_marl.effects import (
    DOMAIN_ALIASES,
    PAPER_WORLDS,
    Acceleration,
    Deceleration,
    Effect,
    EmergencyDeceleration,
    StartupDelay,
    apply_effects,
    domain_label,
    effect_from_record,
    known_effects,
    load_scenario,
    parse_domain,
    scenario_in_domain,
)
from ugat_marl.errors import OptionError, ScenarioError, UnknownNameError
from ugat_marl.experiments import evaluation_of, rule_factory
from ugat_marl.scenarios import Scenario, shipped_scenarios
from ugat_marl.simulation import LibsumoSimulator, launch_of

Crossing = Callable[..., Path]

PAPER = {  # Da et al. (2023), "Real-world Configurations"
    "V1": (1.00, 2.50, 6.00, 0.50),
    "V2": (1.00, 2.50, 6.00, 0.75),
    "V3": (0.75, 3.50, 6.00, 0.25),
    "V4": (0.50, 1.50, 2.00, 0.50),
}


# --- values and names


@pytest.mark.parametrize("name", PAPER)
def test_settings_are_the_paper_s(name: str) -> None:
    accel, decel, emergency, startup = PAPER[name]
    expected = (
        Acceleration(accel),
        Deceleration(decel),
        EmergencyDeceleration(emergency),
        StartupDelay(startup),
    )
    assert PAPER_WORLDS[name] == expected
    alias = next(alias for alias, target in DOMAIN_ALIASES.items() if target == name)
    for spelling in (name, name.lower(), alias, alias.upper(), f" {name}"):
        assert parse_domain(spelling) == expected
    assert domain_label(name.lower()) == domain_label(alias) == name


def test_aliases() -> None:
    assert DOMAIN_ALIASES == {"light-loads": "V1", "heavy-loads": "V2", "rain": "V3", "snow": "V4"}


def test_sim_is_no_effect() -> None:
    assert parse_domain("sim") == parse_domain("SIM") == parse_domain([]) == ()
    assert domain_label([]) == "sim"


def test_domains_of_effects() -> None:
    expected = (StartupDelay(0.5), Acceleration(1.0))
    assert parse_domain("startup_delay=0.5+acceleration=1.0") == expected
    assert parse_domain("startup_delay = 0.5 + acceleration=1") == expected
    assert parse_domain(list(expected)) == expected
    assert domain_label(expected) == "startup_delay=0.5+acceleration=1"
    assert parse_domain(domain_label(expected)) == expected
    assert parse_domain("V1+startup_delay=2") == (*PAPER_WORLDS["V1"], StartupDelay(2.0))


@pytest.mark.parametrize(
    "effect", [e for setting in PAPER_WORLDS.values() for e in setting], ids=str
)
def test_an_effect_survives_every_spelling(effect: Effect) -> None:
    assert parse_domain(str(effect)) == (effect,)
    assert effect_from_record({"name": effect.name, **dataclasses.asdict(effect)}) == effect
    assert type(effect) is known_effects()[effect.name]


@pytest.mark.parametrize(
    ("domain", "message"),
    [
        ("V5", r"unknown domain 'V5'\. Did you mean 'V[1-4]'\? Known: .*snow.*directory"),
        ("heavy-load", r"unknown domain 'heavy-load'\. Did you mean 'heavy-loads'\?"),
        ("reality", r"unknown domain 'reality'\. .*startup_delay=0\.5\+acceleration=1\.0"),
        ("", r"unknown domain ''"),
        ("V1+", r"unknown domain ''"),
        ("startup_dely=0.5", r"unknown effect 'startup_dely'\. Did you mean 'startup_delay'\?"),
    ],
)
def test_unknown_names_get_the_nearest(domain: str, message: str) -> None:
    with pytest.raises(UnknownNameError, match=message):
        parse_domain(domain)


@pytest.mark.parametrize(
    ("domain", "message"),
    [
        ("acceleration=soon", "effect 'acceleration': 'soon' is not a number"),
        ("acceleration=1,2", r"'acceleration' takes 1 value\(s\), mps2; got '1,2'"),
        ("late_green=0.6", r"got '0.6'; everywhere it is late_green=\*,0.6"),
        ("detector_extension=1,split", r"everywhere it is detector_extension=\*,1,split"),
        ("parking=20,60", "got '20,60'; missing: lane$"),
        ("stuck=0,100", "got '0,100'; missing: detector$"),
        ("turning=0.3", "got '0.3'; missing: from_edge, to_edge$"),
        ("demand_level=east1_A1", "got 'east1_A1'; missing: factor$"),
        ("late_green=", "got ''; missing: place, seconds$"),
        ("acceleration=", "effect 'acceleration': '' is not a number"),
        ("acceleration=-1", r"'acceleration': mps2 = -1.0 is outside \[0.1, 10\] m/s\^2"),
        ("startup_delay=60", r"'startup_delay': seconds = 60.0 is outside \[0, 10\] s"),
        ("startup_delay=nan", "effect 'startup_delay': 'nan' is not a number"),
        ("startup_delay=inf", "effect 'startup_delay': 'inf' is not a number"),
    ],
)
def test_impossible_values_are_named(domain: str, message: str) -> None:
    with pytest.raises(OptionError, match=message):
        parse_domain(domain)


@pytest.mark.parametrize("value", ["1", None, True, 0.0999, [1.0]])
def test_what_is_no_plausible_number(value: object) -> None:
    with pytest.raises(OptionError, match="effect 'acceleration': mps2 = "):
        Acceleration(value)  # type: ignore[arg-type]


def test_numbers_of_numpy_are_numbers() -> None:
    assert Acceleration(np.float32(1.5)) == Acceleration(1.5)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("record", "message"),
    [
        ({}, "unknown effect ''"),
        ({"name": "acceleratoin", "mps2": 1}, "unknown effect 'acceleratoin'. Did you mean 'accel"),
        ({"name": "acceleration"}, "effect 'acceleration': parameter 'mps2' is missing"),
        (
            {"name": "acceleration", "mps": 1},
            "unknown parameter of effect 'acceleration': 'mps'. Did you mean 'mps2'",
        ),
    ],
)
def test_records_are_checked(record: dict[str, object], message: str) -> None:
    with pytest.raises((UnknownNameError, OptionError), match=message):
        effect_from_record(record)


# --- every vehicle of the running simulation

TYPED = '<vType id="van" vClass="delivery"/>'
MIX = (
    '<vTypeDistribution id="mix"><vType id="m1" probability="0.5" accel="2"/>'
    '<vType id="m2" vClass="truck" probability="0.5"/></vTypeDistribution>'
)
BY_REFERENCE = (
    '<vType id="r1" accel="2"/><vType id="r2" vClass="bus" decel="3"/>'
    '<vTypeDistribution id="mix" vTypes="r1 r2" probabilities="0.5 0.5"/>'
)
OLD = '<vType id="old"><carFollowing-Krauss accel="2.2" decel="4.2" emergencyDecel="8"/></vType>'

WORLDS: dict[str, dict[str, str]] = {
    "with a type": {"types": TYPED, "type": "van"},
    "without a type": {},
    "default type by name": {"type": "DEFAULT_VEHTYPE"},
    "default type redefined": {"types": '<vType id="DEFAULT_VEHTYPE" accel="2" length="4"/>'},
    "default type is a distribution": {
        "types": '<vTypeDistribution id="DEFAULT_VEHTYPE"><vType id="a" probability="1"/>'
        "</vTypeDistribution>"
    },
    "default type redefined elsewhere": {
        "additional": '<vType id="DEFAULT_VEHTYPE" accel="2" length="4"/>'
    },
    "bicycles": {"type": "DEFAULT_BIKETYPE"},
    "taxis": {"type": "DEFAULT_TAXITYPE"},
    "distribution": {"types": MIX, "type": "mix"},
    "distribution by reference": {"types": BY_REFERENCE, "type": "mix"},
    "distribution elsewhere": {"additional": MIX, "type": "mix"},
    "distribution over types elsewhere": {
        "additional": BY_REFERENCE.split("<vTypeDistribution")[0],
        "types": "<vTypeDistribution" + BY_REFERENCE.split("<vTypeDistribution")[1],
        "type": "mix",
    },
    "distribution with the default type": {
        "types": '<vType id="r1"/><vTypeDistribution id="mix" vTypes="r1 DEFAULT_VEHTYPE"/>',
        "type": "mix",
    },
    "distribution with another of SUMO's types": {
        "types": '<vType id="r1"/><vTypeDistribution id="mix" vTypes="r1 DEFAULT_TAXITYPE"/>',
        "type": "mix",
    },
    "type elsewhere": {"additional": TYPED, "type": "van"},
    "type written in the old way": {"types": OLD, "type": "old"},
    "another model": {"types": '<vType id="idm" carFollowModel="IDM"/>', "type": "idm"},
    "a type nobody uses": {"types": TYPED},
}


def build(crossing: Crossing, world: str, vehicle: str) -> Scenario:
    """The crossing with vehicles of one kind; `vehicle` has a place for their type."""
    spec = WORLDS[world]
    kind = f'type="{spec["type"]}"' if "type" in spec else ""
    toml = None
    if "additional" in spec:
        toml = lambda text: 'additional = ["types.add.xml"]\n' + text  # noqa: E731
    directory = crossing(
        vehicles=vehicle.replace("TYPE", kind), types=spec.get("types", ""), toml=toml
    )
    if "additional" in spec:
        (directory / "types.add.xml").write_text(f"<additional>{spec['additional']}</additional>")
    return load_scenario(directory)


@pytest.fixture
def simulator() -> Iterator[LibsumoSimulator]:
    made = LibsumoSimulator()
    yield made
    made.close()


EVERY_SECOND = (
    "".join(
        f'<vehicle id="v{n}" TYPE route="{road}" depart="{n}"/>'
        for n, road in enumerate(("north", "east") * 6)
    )
    + '<flow id="f" TYPE route="east" begin="12" end="60" period="6"/>'
    + '<trip id="t" TYPE from="W_C" to="C_E" depart="61"/>'
)


@pytest.mark.parametrize("setting", ["V1", "V4"])
@pytest.mark.parametrize("world", WORLDS)
def test_values_are_read_back_from_every_vehicle(
    world: str, setting: str, simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    accel, decel, emergency, startup = PAPER[setting]
    scenario = scenario_in_domain(build(crossing, world, EVERY_SECOND), setting)
    own = tmp_path / "own"
    own.mkdir()
    simulator.start(launch_of(scenario, 1, own, ()))
    seen: dict[str, tuple[float, float, float]] = {}
    types: set[str] = set()
    for _ in range(8):
        simulator.advance(10, {})
        for vehicle in libsumo.vehicle.getIDList():
            api = libsumo.vehicle
            seen[vehicle] = (
                api.getAccel(vehicle), api.getDecel(vehicle), api.getEmergencyDecel(vehicle),
            )  # fmt: skip
            types.add(api.getTypeID(vehicle))
    assert len(seen) == 12 + 8 + 1
    assert set(seen.values()) == {(accel, decel, emergency)}
    if "mix" in WORLDS[world].get("type", ""):
        assert len(types) == 2
    # The start-up delay cannot be read back; it stands in every type that is used.
    written = {
        item.get("id"): item.get("startupDelay")
        for document in (*scenario.additional, *scenario.routes)
        for item in document.parse().iter("vType")
    }
    assert {written[name] for name in types} == {f"{startup:g}"}


def second_of_start(simulator: LibsumoSimulator, scenario: Scenario, own: Path) -> int:
    """The light turns green in second 10; when does the car before it begin to move?"""
    own.mkdir()
    simulator.start(launch_of(scenario, 1, own, ("W_C_0",)))
    simulator.advance(10, {"C": [(10.0, "Gr")]})
    assert libsumo.vehicle.getSpeed("v") == 0
    for second in range(10, 30):
        simulator.advance(1, {"C": [(1.0, "rG")]})
        if libsumo.vehicle.getSpeed("v") > 0:
            return second
    raise AssertionError("it never started")


STANDING = '<vehicle id="v" TYPE route="east" depart="0" departPos="490" departSpeed="0"/>'


@pytest.mark.parametrize("world", WORLDS)
def test_the_start_up_delay_is_felt(
    world: str, simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    scenario = build(crossing, world, STANDING)
    at_once = second_of_start(simulator, scenario, tmp_path / "at once")
    delayed = apply_effects(scenario, [StartupDelay(3.0)])
    assert at_once == 10
    assert second_of_start(simulator, delayed, tmp_path / "delayed") == at_once + 3


def trace(simulator: LibsumoSimulator, scenario: Scenario, own: Path) -> list[tuple[str, object]]:
    own.mkdir()
    simulator.start(launch_of(scenario, 1, own, ()))
    found: list[tuple[str, object]] = []
    for _ in range(8):
        simulator.advance(10, {})
        found += [(name, libsumo.vehicle.getPosition(name)) for name in libsumo.vehicle.getIDList()]
    return found


def test_writing_down_the_defaults_changes_nothing(
    simulator: LibsumoSimulator, crossing: Crossing, tmp_path: Path
) -> None:
    """An effect moves its own attribute and no other property of a vehicle."""
    scenario = build(crossing, "without a type", EVERY_SECOND)
    plain = trace(simulator, scenario, tmp_path / "plain")
    defaults = [Acceleration(2.6), Deceleration(4.5), EmergencyDeceleration(9), StartupDelay(0)]
    assert trace(simulator, apply_effects(scenario, defaults), tmp_path / "same") == plain
    assert trace(simulator, scenario_in_domain(scenario, "V1"), tmp_path / "other") != plain


def test_who_does_not_drive_is_left_alone(crossing: Crossing) -> None:
    types = '<vType id="walker" vClass="pedestrian"/><vType id="tram" vClass="tram" accel="1"/>'
    scenario = load_scenario(
        crossing(vehicles='<vehicle id="v" depart="0" route="east"/>', types=types)
    )
    types_after = {
        item.get("id"): item.get("accel")
        for item in apply_effects(scenario, [Acceleration(0.5)]).routes[0].parse().iter("vType")
    }
    assert types_after == {"car": "0.5", "walker": None, "tram": "1"}


# --- effects are pure


def test_the_original_does_not_change(crossing: Crossing) -> None:
    directory = crossing()
    before = {file: file.read_bytes() for file in directory.iterdir()}
    scenario = load_scenario(directory)
    original = scenario.hash
    derived = {
        name: scenario_in_domain(scenario, name) for name in (*PAPER_WORLDS, "acceleration=2.5")
    }
    assert load_scenario(directory).hash == scenario.hash == original
    assert len({original, *(item.hash for item in derived.values())}) == 2 + len(PAPER_WORLDS)
    assert {file: file.read_bytes() for file in directory.iterdir()} == before
    assert scenario_in_domain(scenario, "V2").hash == derived["V2"].hash
    assert derived["V1"].applied == tuple(map(str, PAPER_WORLDS["V1"]))
    assert derived["V1"].id == scenario.id


def test_the_order_of_different_effects_does_not_matter(crossing: Crossing) -> None:
    scenario = load_scenario(crossing())
    effects = list(PAPER_WORLDS["V3"])

    def types(derived: Scenario) -> list[dict[str, str]]:
        documents = (*derived.additional, *derived.routes)
        return [dict(item.items()) for file in documents for item in file.parse().iter("vType")]

    one_way, the_other = (apply_effects(scenario, order) for order in (effects, effects[::-1]))
    assert types(one_way) == types(the_other) != types(scenario)


def test_the_last_of_two_equal_effects_counts(crossing: Crossing) -> None:
    scenario = load_scenario(crossing())
    twice = apply_effects(scenario, [StartupDelay(2), StartupDelay(1)])
    assert twice.hash == apply_effects(scenario, [StartupDelay(1)]).hash


def test_effects_of_a_scenario_file_are_applied_when_it_is_loaded(crossing: Crossing) -> None:
    listed = '[[effects]]\nname = "startup_delay"\nseconds = 0.5\n'
    plain, changed = crossing(), crossing(toml=lambda text: text + listed)
    expected = apply_effects(load_scenario(plain), [StartupDelay(0.5)])
    assert load_scenario(changed).hash == expected.hash
    assert load_scenario(load_scenario(changed)).hash == expected.hash
    assert load_scenario(changed).applied == ("startup_delay=0.5",)


# --- a corrected scenario as a domain


def test_a_written_scenario_is_a_domain(crossing: Crossing, tmp_path: Path) -> None:
    scenario = load_scenario(crossing())
    corrected = scenario_in_domain(scenario, "V3").write(tmp_path / "corrected")
    assert (
        scenario_in_domain(scenario, str(corrected)).hash == scenario_in_domain(scenario, "V3").hash
    )
    env = parallel_env(scenario, str(corrected), simulator="inprocess")
    reference = parallel_env(scenario, "V3", simulator="inprocess")
    rewards = []
    for item in (env, reference):
        item.reset(seed=4)
        rewards.append([item.step({"signal_0": n // 9})[1]["signal_0"] for n in range(18)])
        item.close()
    assert rewards[0] == rewards[1]
    assert any(rewards[0])


def test_a_domain_on_other_roads_is_refused(crossing: Crossing) -> None:
    other = dict(shipped_scenarios())["single-v1"]
    with pytest.raises(ScenarioError, match=r"has other roads or signals than scenario 'crossing0"):
        scenario_in_domain(load_scenario(crossing()), str(other))


@pytest.mark.parametrize(
    ("control", "says"),
    [
        ({"decision_interval_s": 5.0}, r"decides every 5 s, and scenario '.*' every 10 s"),
        ({"phases": "permitted"}, r"other phases than scenario 'single-v1': phase \d of .*'A1'"),
        ({"phases": "programme"}, r"phase 1 of traffic light 'A1' is \w+ there and \w+ here"),
    ],
)
def test_a_domain_in_which_actions_mean_something_else_is_refused(
    control: dict[str, Any], says: str, tmp_path: Path
) -> None:
    scenario = load_scenario("single-v1")
    other = scenario.with_control(**control).write(tmp_path / "other")
    with pytest.raises(ScenarioError, match=says):
        scenario_in_domain(scenario, str(other))
    same = scenario.with_control(yellow_s=4.0, min_green_s=10.0).write(tmp_path / "same")
    assert scenario_in_domain(scenario, str(same)).timing.yellow_s == 4.0


# --- on what is shipped, in SUMO without the suite


@pytest.mark.parametrize("name", [name for name, _ in shipped_scenarios()])
def test_a_shipped_scenario_in_v4_runs_in_plain_sumo(name: str, tmp_path: Path) -> None:
    directory = scenario_in_domain(load_scenario(name), "V4").write(tmp_path / name)
    again = load_scenario(directory)
    trips = tmp_path / "trips.xml"
    subprocess.run(
        [
            str(Path(sumo.SUMO_HOME) / "bin" / "sumo"), "--no-step-log", "--end", "120",
            "-n", directory / again.network.name,
            "-r", ",".join(str(directory / item.name) for item in again.routes),
            "-a", ",".join(str(directory / item.name) for item in again.additional),
            "--vehroute-output", trips, "--vehroute-output.write-unfinished",
        ],
        check=True, capture_output=True, env={**os.environ, "SUMO_HOME": ""},
    )  # fmt: skip
    used = {item.get("type", "DEFAULT_VEHTYPE") for item in ET.parse(trips).iter("vehicle")}
    types = {
        item.get("id"): item
        for document in (*again.additional, *again.routes)
        for item in document.parse().iter("vType")
    }
    assert used
    for kind in used:
        values = [
            float(types[kind].get(key, "nan"))
            for key in ("accel", "decel", "emergencyDecel", "startupDelay")
        ]
        assert tuple(values) == PAPER["V4"], kind


# --- junctions


def test_the_option_for_blocked_junctions_reaches_sumo_and_no_diagnosis_looks_for_it(
    tmp_path: Path,
) -> None:
    assert "blocker_patience" not in known_effects()
    scenario = scenario_in_domain(load_scenario("single-v1"), "blocker_patience=45")
    assert scenario.hash != load_scenario("single-v1").hash
    arguments = launch_of(scenario, 1, tmp_path, ()).arguments
    assert arguments[arguments.index("--ignore-junction-blocker") + 1] == "45"
    with pytest.raises(OptionError, match="blocker_patience"):
        scenario_in_domain(load_scenario("single-v1"), "blocker_patience=0")


@pytest.mark.skipif(
    importlib.util.find_spec("sumo_rl") is None, reason="the RESCO networks come with sumo-rl"
)
def test_vehicles_that_hold_each_other_on_a_junction_let_go() -> None:
    """Slow vehicles of cologne3 meet on its largest junction, with this rule and this seed."""
    arrived: dict[str, float] = {}
    for domain in ("V1", "V1+blocker_patience=60"):
        rule = {"rule": rule_factory("sotl:300:20")}
        found = evaluation_of(
            load_scenario("resco:cologne3"), rule, [domain], [1002], duration_s=1200, workers=1
        )
        arrived[domain] = found.results[0].scores.throughput / found.results[0].scores.due
    assert arrived["V1"] < 0.6
    assert arrived["V1+blocker_patience=60"] > 0.8


@pytest.mark.parametrize("later", ["yellow_time=4", "all_red_time=1"])
def test_a_clearance_behind_the_queue_model_is_refused(later: str) -> None:
    """The queue model has made red of the yellow by then."""
    with pytest.raises(ScenarioError, match="put .* before it"):
        scenario_in_domain(load_scenario("single-v1"), f"meso+{later}")
    changed = scenario_in_domain(load_scenario("single-v1"), f"{later}+meso")
    assert changed.timing.yellow_s == 0
