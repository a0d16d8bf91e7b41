"""Scenarios: read, refused with reasons, hashed, derived, written and read again."""

from __future__ import annotations

import gzip
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable
from dataclasses import FrozenInstanceError, replace
from pathlib import Path

import pydantic
import pytest
import sumo
from hypothesis import given
from hypothesis import strategies as st

from ugat_marl.effects import Acceleration, DemandLevel, LateGreen, apply_effects, load_scenario
from ugat_marl.errors import OutputError, ScenarioError, UnknownNameError
from ugat_marl.scenarios import (
    Document,
    Scenario,
    parse_time,
    read_scenario,
    shipped_scenarios,
    validate_settings,
)
from ugat_marl.scenarios.admission import OPTIONS
from ugat_marl.scenarios.scenario import SumoConfiguration, scenario_toml

Crossing = Callable[..., Path]
MINIMAL = {"network": "n.net.xml", "routes": ["r.rou.xml"]}


def test_the_crossing_is_read(crossing: Crossing) -> None:
    scenario = read_scenario(crossing())
    assert scenario.id == "crossing0-v1"
    assert scenario.network.name == "network.net.xml"
    assert [document.name for document in scenario.routes] == ["demand.rou.xml"]
    assert scenario.additional == ()
    assert scenario.settings.duration_s == 200
    assert scenario.control.decision_interval_s == 10
    assert scenario.control.phases == "programme"
    assert scenario.decisions == 20
    assert scenario.applied == ()


def test_defaults_are_the_ones_documented(tmp_path: Path) -> None:
    settings = validate_settings(MINIMAL, "here")
    control = settings.control
    assert (settings.begin_s, settings.duration_s, settings.step_length_s) == (0, 3600, 1)
    assert (control.decision_interval_s, control.yellow_s, control.all_red_s) == (10, 3, 2)
    assert (control.min_green_s, control.phases) == (5, "programme")


def test_a_scenario_is_found_by_directory_file_and_name(crossing: Crossing) -> None:
    directory = crossing()
    by_directory = read_scenario(directory)
    assert read_scenario(str(directory)).hash == by_directory.hash
    assert read_scenario(directory / "scenario.toml").hash == by_directory.hash
    name, shipped = next(iter(shipped_scenarios()))
    assert read_scenario(name).hash == read_scenario(shipped).hash
    assert read_scenario(name).id == name


def test_the_directory_at_hand_is_named_by_its_path(
    crossing: Crossing, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(crossing())
    assert read_scenario(".").id == "crossing0-v1"


def test_a_scenario_is_a_value(crossing: Crossing) -> None:
    scenario = read_scenario(crossing())
    with pytest.raises(FrozenInstanceError):
        scenario.id = "other"  # type: ignore[misc]
    with pytest.raises(pydantic.ValidationError):
        scenario.settings.begin_s = 1.0  # type: ignore[misc]


# --- the hash ------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", ["true", '"200"', '"1_000"'])
def test_what_only_python_takes_for_a_number_is_refused(crossing: Crossing, wrong: str) -> None:
    with pytest.raises(ScenarioError, match=r"scenario\.toml: .*duration_s"):
        read_scenario(
            crossing(toml=lambda text: text.replace("duration_s = 200", f"duration_s = {wrong}"))
        )


def test_the_hash_knows_every_byte_and_setting(crossing: Crossing) -> None:
    hashes = {
        read_scenario(directory).hash
        for directory in (
            crossing(),
            crossing(edit=lambda text: text.replace('speed="10.00"', 'speed="10.01"')),
            crossing(vehicles=""),
            crossing(toml=lambda text: text.replace("yellow_s = 0", "yellow_s = 3")),
            crossing(toml=lambda text: text.replace("duration_s = 200", "duration_s = 210")),
            crossing(toml=lambda text: text + '[intersections.C]\nphases = ["Gr", "rG"]\n'),
            crossing(toml=lambda text: text + '[sumo]\nlateral-resolution = "0.8"\n'),
        )
    }
    assert len(hashes) == 7
    assert all(re.fullmatch("[0-9a-f]{64}", value) for value in hashes)


def test_the_hash_does_not_know_what_changes_nothing(crossing: Crossing) -> None:
    plain = crossing()
    other = crossing(toml=lambda text: text.replace("Two one-lane roads", "Roads"))
    (other / "network.net.xml").rename(other / "renamed.net.xml")
    (other / "scenario.toml").write_text(
        (other / "scenario.toml").read_text().replace("network.net.xml", "renamed.net.xml")
        + "# a remark\n"
    )
    packed = crossing(toml=lambda text: text.replace("network.net.xml", "network.net.xml.gz"))
    net = packed / "network.net.xml"
    (packed / "network.net.xml.gz").write_bytes(gzip.compress(net.read_bytes()))
    net.unlink()
    assert {read_scenario(directory).hash for directory in (plain, other, packed)} == {
        read_scenario(plain).hash
    }


def test_files_do_not_flow_into_each_other(crossing: Crossing) -> None:
    """Moving the border between two route files must change the hash."""
    first, second = crossing(), crossing()
    for directory, (a, b) in ((first, ("\n\n", "\n")), (second, ("\n", "\n\n"))):
        (directory / "a.xml").write_text(f"<routes/>{a}")
        (directory / "b.xml").write_text(f"{b}<routes/>")
        toml = directory / "scenario.toml"
        toml.write_text(toml.read_text().replace('"demand.rou.xml"', '"a.xml", "b.xml"'))
    assert read_scenario(first).hash != read_scenario(second).hash


# --- derived scenarios ---------------------------------------------------------------------------


def test_with_control_and_duration_leave_the_original(crossing: Crossing) -> None:
    scenario = read_scenario(crossing())
    before = scenario.hash
    longer = scenario.with_duration(400)
    faster = scenario.with_control(decision_interval_s=5, phases=("rG", "Gr"))
    assert (longer.decisions, scenario.decisions, faster.decisions) == (40, 20, 40)
    assert faster.control.phases == ("rG", "Gr")
    assert scenario.hash == before
    assert len({before, longer.hash, faster.hash}) == 3
    with pytest.raises(ScenarioError, match="scenario 'crossing0-v1': control.yellow_s = -1"):
        scenario.with_control(yellow_s=-1)
    with pytest.raises(ScenarioError, match="unknown key 'control.yelow_s'; did you mean 'yellow"):
        scenario.with_control(yelow_s=1)
    with pytest.raises(ScenarioError, match="duration_s = 5 is shorter than one decision interval"):
        scenario.with_duration(5)


def test_a_key_in_the_wrong_place_is_told_where_it_belongs(crossing: Crossing) -> None:
    file = crossing() / "scenario.toml"
    file.write_text('phases = "programme"\n' + file.read_text())
    with pytest.raises(ScenarioError, match=r"unknown key 'phases'; it belongs under \[control\]"):
        read_scenario(file.parent)


def test_a_name_that_is_too_long_is_no_scenario() -> None:
    with pytest.raises(UnknownNameError, match="unknown scenario 'aaa"):
        read_scenario("a" * 300)


@pytest.mark.parametrize(
    ("duration", "interval", "step", "decisions"),
    [(3600, 10, 1, 360), (3600, 0.1, 0.1, 36000), (0.3, 0.1, 0.1, 3), (95, 10, 1, 9)],
)
def test_decisions(duration: float, interval: float, step: float, decisions: int) -> None:
    settings = {
        **MINIMAL,
        "duration_s": duration,
        "step_length_s": step,
        "control": {"decision_interval_s": interval},
    }
    scenario = Scenario("x", Document("n"), (), (), validate_settings(settings, "here"))
    assert scenario.decisions == decisions


def test_written_and_read_again_it_is_the_same(crossing: Crossing, tmp_path: Path) -> None:
    directory = crossing(
        toml=lambda text: (
            (
                text.replace('description = "', 'description = "grün \\u0007 \\" \\U0001F6A6 ')
                + 'min_green_s = 0.5\n[intersections.C]\nphases = ["Gr", "rG"]\n'
                '[sumo]\n"lateral-resolution" = "0.8"\n'
                '[[effects]]\nname = "acceleration"\nmps2 = 1.5\n'
            )
            .replace("min_green_s = 0\n", "", 1)
            .replace("duration_s = 200", "duration_s = 200\nstep_length_s = 0.5")
        )
    )
    scenario = read_scenario(directory)
    copy = read_scenario(scenario.write(tmp_path / "copy"))
    assert copy.hash == scenario.hash
    assert copy.settings == scenario.settings
    assert "🚦" in copy.settings.description
    # It takes the place of another one.
    assert read_scenario(copy.write(directory)).hash == scenario.hash


def test_files_that_only_a_replaced_scenario_names_stay(crossing: Crossing, tmp_path: Path) -> None:
    scenario = read_scenario(crossing())
    plans = Document("plans.add.xml", None, b"<additional/>")
    place = replace(scenario, additional=(plans,)).write(tmp_path / "place")
    assert read_scenario(scenario.write(place)).hash == scenario.hash
    assert (place / "plans.add.xml").read_bytes() == b"<additional/>"


def test_a_scenario_is_not_written_over_the_files_it_is_read_from(
    crossing: Crossing, tmp_path: Path
) -> None:
    directory = crossing()
    before = {file.name: file.read_bytes() for file in directory.iterdir()}
    (tmp_path / "link").symlink_to(directory)
    changed = apply_effects(read_scenario(directory), [DemandLevel("*", 0.5), LateGreen("*", 2.0)])
    for place in (directory, tmp_path / "link"):
        with pytest.raises(OutputError, match="it there would change it; give another dir"):
            changed.write(place)
    assert {file.name: file.read_bytes() for file in directory.iterdir()} == before


def test_a_scenario_is_not_written_over_files_it_links_to(
    crossing: Crossing, tmp_path: Path
) -> None:
    directory, data = crossing(), tmp_path / "data"
    data.mkdir()
    for name in ("network.net.xml", "demand.rou.xml"):
        (directory / name).rename(data / name)
    toml = directory / "scenario.toml"
    text = toml.read_text()
    for name in ("network.net.xml", "demand.rou.xml"):
        text = text.replace(f'"{name}"', f'"{data / name}"')
    toml.write_text(text)
    before = {file.name: file.read_bytes() for file in data.iterdir()}
    changed = apply_effects(read_scenario(directory), [DemandLevel("*", 0.5), LateGreen("*", 2.0)])
    with pytest.raises(OutputError, match=r"network\.net\.xml: scenario .* read from this file"):
        changed.write(data)
    assert {file.name: file.read_bytes() for file in data.iterdir()} == before


@given(
    st.text(max_size=30),
    st.dictionaries(st.text(min_size=1, max_size=8), st.just({"phases": ["Gr", "rG"]}), max_size=2),
)
def test_any_text_survives_the_way_through_toml(
    description: str, lights: dict[str, dict[str, list[str]]]
) -> None:
    settings = validate_settings(
        {**MINIMAL, "description": description, "intersections": lights}, "here"
    )
    text = scenario_toml(settings.model_dump(mode="json"), ("acceleration=1",))
    assert validate_settings(tomllib.loads(text), "again") == settings


def test_a_derived_scenario_runs_in_plain_sumo(crossing: Crossing, tmp_path: Path) -> None:
    derived = apply_effects(load_scenario(crossing()), [Acceleration(1.25)])
    directory = derived.write(tmp_path / "derived")
    text = (directory / "scenario.toml").read_text()
    assert text.startswith("# made by applying acceleration=1.25\n")
    again = load_scenario(directory)
    assert again.hash == derived.hash
    subprocess.run(
        [
            str(Path(sumo.SUMO_HOME) / "bin" / "sumo"), "--no-step-log", "--end", "100",
            "-n", directory / again.network.name,
            "-r", ",".join(str(directory / item.name) for item in again.routes),
            "-a", ",".join(str(directory / item.name) for item in again.additional),
        ],
        check=True, capture_output=True, env={**os.environ, "SUMO_HOME": ""},
    )  # fmt: skip


def test_two_files_of_one_name_are_not_written_over_each_other(
    crossing: Crossing, tmp_path: Path
) -> None:
    directory = crossing(
        toml=lambda text: text.replace('"demand.rou.xml"', '"demand.rou.xml", "b/demand.rou.xml"')
    )
    (directory / "b").mkdir()
    (directory / "b" / "demand.rou.xml").write_text("<routes/>")
    with pytest.raises(ScenarioError, match=r"two of its files are called 'demand\.rou\.xml'"):
        read_scenario(directory).write(tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


# --- a .sumocfg ----------------------------------------------------------------------------------


def configure(directory: Path, content: str) -> Path:
    file = directory / "city.sumocfg"
    file.write_text(f"<configuration>{content}</configuration>")
    return file


INPUT = '<input><net-file value="network.net.xml"/><route-files value="demand.rou.xml"/></input>'


def test_a_sumocfg_needs_nothing_else(crossing: Crossing) -> None:
    directory = crossing()
    file = configure(
        directory,
        INPUT + '<time><begin value="100"/><end value="0:05:00"/><step-length value="0.5"/></time>'
        '<processing><lateral-resolution value="0.8"/><time-to-teleport value="300"/>'
        '<max-depart-delay value="10"/><ignore-route-errors value="true"/></processing>'
        '<report><no-step-log value="true"/><error-log value="/tmp/e"/></report>'
        '<output><tripinfo-output value="/tmp/x"/></output>',
    )
    scenario = read_scenario(file)
    assert scenario.id == "city"
    settings = scenario.settings
    assert (settings.begin_s, settings.duration_s, settings.step_length_s) == (100, 200, 0.5)
    # What concerns output, seeds, teleporting and waiting to enter is the suite's own.
    assert settings.sumo == {"lateral-resolution": "0.8", "ignore-route-errors": "true"}


def test_a_sumocfg_may_use_other_names(crossing: Crossing) -> None:
    directory = crossing()
    plain = configure(directory, INPUT + '<end value="100"/>')
    expected = read_scenario(plain).hash
    file = configure(
        directory,
        '<input><n v="network.net.xml"/><r v="demand.rou.xml"/></input><time><e v="100"/></time>',
    )
    assert read_scenario(file).hash == expected


def test_options_of_a_sumocfg_may_have_former_names(crossing: Crossing) -> None:
    directory = crossing()
    options = {
        "default.carfollowmodel": ("carfollow.model", "IDM"),
        "device.rerouting.period": ("device.routing.period", "30"),
        "device.rerouting.explicit": ("device.routing.knownveh", "a"),
        "device.emissions.explicit": ("device.emissions.knownveh", "a"),
    }
    written = "".join(f'<{former} value="{value}"/>' for former, value in options.values())
    scenario = read_scenario(configure(directory, INPUT + written + '<srand value="4"/>'))
    assert scenario.settings.sumo == {name: value for name, (_, value) in options.items()}
    assert SumoConfiguration(directory / "city.sumocfg").ignored() == ["seed = 4"]


@pytest.mark.parametrize("no", ["false", "0", "Off", "-"])
def test_a_sumocfg_may_say_that_it_has_car_following(no: str, crossing: Crossing) -> None:
    directory = crossing()
    expected = read_scenario(configure(directory, INPUT)).hash
    file = configure(directory, f'{INPUT}<mesosim value="{no}"/>')
    assert read_scenario(file).hash == expected
    with pytest.raises(ScenarioError, match="mesosim = 'true': the mesoscopic model"):
        read_scenario(configure(directory, f'{INPUT}<mesosim value="true"/>'))


def test_options_of_a_sumocfg_count_wherever_they_stand(crossing: Crossing) -> None:
    directory = crossing()
    times = '<begin value="100"/><end value="200"/>'
    options = '<scale value="2"/><lateral-resolution value="0.8"/>'
    usual = configure(directory, f"{INPUT}<time>{times}</time><processing>{options}</processing>")
    expected = read_scenario(usual)
    assert expected.settings.sumo == {"scale": "2", "lateral-resolution": "0.8"}
    for content in (
        INPUT + times + options,
        f"{INPUT}<report>{options}</report><odd>{times}</odd>",
    ):
        assert read_scenario(configure(directory, content)).hash == expected.hash


def test_file_names_with_blanks_and_lists(crossing: Crossing) -> None:
    directory = crossing()
    shutil.copy(directory / "demand.rou.xml", directory / "my demand.rou.xml")
    for value in ("my demand.rou.xml, demand.rou.xml", "demand.rou.xml demand.rou.xml"):
        file = configure(
            directory, f'<net-file value="network.net.xml"/><route-files value="{value}"/>'
        )
        names = [document.name for document in read_scenario(file).routes]
        assert len(names) == 2
        assert names[1] == "demand.rou.xml"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('<route-files value="demand.rou.xml"/>', "no <net-file value=...>; a scenario needs a"),
        ('<net-file value="network.net.xml"/>', "no <route-files value=...>; a scenario needs v"),
        (INPUT + '<begin value="soon"/>', "begin = 'soon' is not a time in seconds"),
        (INPUT + '<begin value="9"/><end value="9"/>', r"end \(9 s\) is not after begin \(9 s\)"),
        (INPUT.replace("demand", "gone"), "<route-files> names 'gone.rou.xml', but .* does not ex"),
        ("<input>", "not well-formed XML"),
    ],
)
def test_bad_configurations(content: str, message: str, crossing: Crossing) -> None:
    with pytest.raises(ScenarioError, match=rf"city\.sumocfg: {message}"):
        read_scenario(configure(crossing(), content))


def test_detectors_do_not_write_beside_the_user_s_files(crossing: Crossing) -> None:
    directory = crossing(toml=lambda text: 'additional = ["d.add.xml"]\n' + text)
    content = (
        '<additional><inductionLoop id="loop" lane="W_C_0" pos="-5" period="10" file="out.xml"/>'
        "</additional>"
    )
    (directory / "d.add.xml").write_text(content)
    (document,) = read_scenario(directory).additional
    assert document.parse()[0].get("file") == "NUL"
    assert (directory / "d.add.xml").read_text() == content


# --- RESCO ---------------------------------------------------------------------------------------


def fake_wheel(directory: Path, crossing: Path) -> Path:
    """A package called sumo_rl that must not be imported, with one map."""
    package = directory / "sumo_rl"
    home = package / "nets" / "RESCO" / "cologne9"
    shutil.copytree(crossing, home)
    configure(home, INPUT).rename(home / "cologne9.sumocfg")
    (package / "__init__.py").write_text("raise RuntimeError('imported')\n")
    return directory


def test_resco_maps_are_found_without_importing_the_wheel(
    crossing: Crossing, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(fake_wheel(tmp_path / "site", crossing()))
    assert read_scenario("resco:cologne9").id == "resco:cologne9"
    assert "sumo_rl" not in sys.modules
    with pytest.raises(UnknownNameError, match="unknown RESCO map 'cologne3'. Did you mean 'colog"):
        read_scenario("resco:cologne3")


def test_without_the_wheel_the_error_says_how_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == "sumo_rl" else find(name, *a)
    )
    with pytest.raises(ScenarioError, match=r"pip install 'sumo-rl\b"):
        read_scenario("resco:cologne3")


# --- values --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("0", 0), ("12.5", 12.5), ("1:02:03", 3723), ("1:00:00:00", 86400), ("-1", -1)],
)
def test_times_as_sumo_writes_them(text: str, seconds: float) -> None:
    assert parse_time(text) == seconds


@pytest.mark.parametrize("text", ["", "soon", "1:2", "1:2:3:4:5", "1::2"])
def test_what_is_no_time(text: str) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - any message: the caller names file and key
        parse_time(text)


@pytest.mark.parametrize(
    ("option", "allowed"),
    [
        ("lateral-resolution", True),
        ("ignore-route-errors", True),
        ("step-method.ballistic", True),
        ("device.rerouting.probability", True),
        ("tripinfo-output", False),
        ("tripinfo-output.write-unfinished", False),
        ("duration-log.disable", False),
        ("route-files", False),
        ("configuration-file", False),
        ("seed", False),
        ("random", False),
        ("begin", False),
        ("end", False),
        ("step-length", False),
        ("time-to-teleport", False),
        ("max-depart-delay", False),
        ("time-to-teleport.highways", True),
        ("no-warnings", False),
        ("remote-port", False),
    ],
)
def test_which_options_of_sumo_a_scenario_may_set(option: str, allowed: bool) -> None:
    assert (option in OPTIONS) is allowed
    raw = {**MINIMAL, "sumo": {option: "1"}}
    if allowed:
        assert validate_settings(raw, "here").sumo == {option: "1"}
    else:
        message = f"here: sumo.{option} is set by the suite or names files, and cannot be given"
        with pytest.raises(ScenarioError, match=re.escape(message)):
            validate_settings(raw, "here")
