"""Scenarios of a stranger: none may read or write a file outside, with the list or without it.

Each case puts one hostile thing into a harmless scenario. It names `{out}`, a file of the user that
must keep its content, or `{secret}`, one whose content must not come out. Without the list of
`ugat_marl.scenarios.admission` the kernel alone has to hold.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from ugat_marl.envs import parallel_env, vector_env
from ugat_marl.errors import ScenarioError, UgatMarlError
from ugat_marl.files import Document
from ugat_marl.scenarios import admission, read_scenario, scenario, settings
from ugat_marl.scenarios.confinement import MEMORY_VARIABLE, confinement_missing

Crossing = Callable[..., Path]

KEPT = "what the user wrote"
SECRET = "SECRET-OF-THE-USER"

OPTIONS = [
    "netstate-dump", "summary", "summary-output", "l", "log", "message-log", "error-log",
    "save-configuration", "C", "save-template", "save-schema", "save-state.prefix",
    "save-state.files", "c", "configuration-file", "tripinfo", "tripinfo-output", "fcd-output",
    "full-output", "queue-output", "vtk-output", "amitran-output", "emission-output",
    "lanechange-output", "stop-output", "collision-output", "edgedata-output", "lanedata-output",
    "statistic-output", "deadlock-output", "link-output", "bt-output", "battery-output",
    "vehroute-output", "vehroutes", "personinfo-output", "person-summary-output",
    "device.rerouting.output", "device.ssm.file", "device.toc.file",
    "device.taxi.dispatch-algorithm.output", "phemlight-path", "weight-files", "load-state",
    "output-prefix",
]  # fmt: skip

ADDITIONAL = {
    "metadata": '<metadata><configuration><output><edgeData id="d" file="{out}"/>'
    "</output></configuration></metadata>",
    "metadata include": '<metadata><configuration><include href="{secret}"/></configuration>'
    "</metadata>",
    "timedEvent": '<timedEvent type="SaveTLSStates" source="C" dest="{out}"/>',
    "calibrator": '<calibrator id="c" edge="W_C" pos="0" output="{out}" freq="10"/>',
    "include": '<include href="{secret}"/>',
    "induction loop": '<inductionLoop id="d" lane="W_C_0" pos="5" period="10" file="{out}"/>',
    "e1Detector": '<e1Detector id="d" lane="W_C_0" pos="5" freq="10" file="{out}"/>',
    "instant": '<instantInductionLoop id="d" lane="W_C_0" pos="5" file="{out}"/>',
    "area": '<laneAreaDetector id="d" lane="W_C_0" pos="5" length="9" freq="9" file="{out}"/>',
    "edgeData": '<edgeData id="d" file="{out}"/>',
    "laneData": '<laneData id="d" file="{out}"/>',
    "edges file": '<edgeData id="d" file="NUL" edgesFile="{secret}"/>',
    "routeProbe": '<routeProbe id="d" edge="W_C" freq="10" file="{out}"/>',
    "vTypeProbe": '<vTypeProbe id="d" freq="10" file="{out}"/>',
    "rerouter": '<rerouter id="d" edges="W_C" file="{secret}"/>',
    "sign": '<variableSpeedSign id="d" lanes="W_C_0" file="{secret}"/>',
    "calibrator file": '<calibrator id="c" edge="W_C" pos="0" file="{secret}"/>',
    "ssm": '<vType id="t"><param key="has.ssm.device" value="true"/>'
    '<param key="device.ssm.file" value="{out}"/></vType>',
    "actuated": '<tlLogic id="C" type="actuated" programID="x" offset="0"><param key="file" '
    'value="{out}"/><phase duration="9" state="rG"/><phase duration="9" state="Gr"/></tlLogic>',
}
ROUTES = {
    "ssm of a type": '<vType id="t"><param key="has.ssm.device" value="true"/>'
    '<param key="device.ssm.file" value="{out}"/></vType>',
    "ssm of a vehicle": '<vehicle id="s" depart="0" route="east">'
    '<param key="has.ssm.device" value="true"/>'
    '<param key="device.ssm.file" value="{out}"/></vehicle>',
    "toc": '<vType id="t"><param key="has.toc.device" value="true"/>'
    '<param key="device.toc.file" value="{out}"/></vType>',
    "include": '<include href="{secret}"/>',
}
CASES = [
    *[("option", name) for name in OPTIONS],
    *[("additional", name) for name in ADDITIONAL],
    *[("routes", name) for name in ROUTES],
    *[("network", name) for name in ("induction loop", "edgeData", "timedEvent", "include")],
]


@pytest.fixture
def around(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The user's folder: the current one, with a file to keep and a secret."""
    folder = tmp_path / "user"
    folder.mkdir()
    (folder / "kept.txt").write_text(KEPT)
    (folder / "secret.xml").write_text(f"<{SECRET} {SECRET}='1'/>")
    monkeypatch.chdir(folder)
    yield folder
    assert {path.name for path in folder.iterdir()} == {"kept.txt", "secret.xml"}
    assert (folder / "kept.txt").read_text() == KEPT


def hostile(crossing: Crossing, kind: str, name: str, user: Path) -> Path:
    """Return a scenario, as a SUMO configuration, with one hostile thing."""
    names = {"out": user / "kept.txt", "secret": user / "secret.xml"}
    vehicle = '<vehicle id="a" depart="0" route="east"/>'
    routes = ROUTES[name].format(**names) if kind == "routes" else ""
    directory = crossing(vehicles=f"{routes}{vehicle}")
    processing = extra = ""
    if kind == "option":
        reads = name in ("c", "configuration-file", "weight-files", "load-state", "phemlight-path")
        processing = f'<{name} value="{names["secret" if reads else "out"]}"/>'
        if name == "device.ssm.file":
            processing += '<device.ssm.probability value="1"/>'
    if kind == "additional":
        extra = '<additional-files value="extra.add.xml"/>'
        text = ADDITIONAL[name].format(**names)
        (directory / "extra.add.xml").write_text(f"<additional>{text}</additional>")
    if kind == "network":
        network = directory / "network.net.xml"
        text = ADDITIONAL[name].format(**names)
        network.write_text(network.read_text().replace("</net>", f"{text}</net>"))
    path = directory / "x.sumocfg"
    path.write_text(
        '<configuration><input><net-file value="network.net.xml"/>'
        f'<route-files value="demand.rou.xml"/>{extra}</input>'
        '<time><begin value="0"/><end value="60"/></time>'
        f"<processing>{processing}</processing></configuration>"
    )
    return path


def play(path: Path, simulator: str = "process") -> str:
    """Simulate a scenario for a minute; return the error, or nothing."""
    try:
        env = parallel_env(read_scenario(path), simulator=simulator)
    except UgatMarlError as error:
        return str(error)
    try:
        env.reset(seed=0)
        while env.agents:
            env.step(dict.fromkeys(env.agents, 0))
    except UgatMarlError as error:
        return str(error)
    finally:
        env.close()
    return ""


@pytest.mark.parametrize(("kind", "name"), CASES)
def test_a_hostile_scenario_is_refused_or_harmless(
    kind: str, name: str, crossing: Crossing, around: Path
) -> None:
    path = hostile(crossing, kind, name, around)
    said = play(path)
    assert SECRET not in said
    assert "\n" not in said


@pytest.mark.skipif(
    bool(confinement_missing()), reason=f"only the list protects here: {confinement_missing()}"
)
@pytest.mark.parametrize(("kind", "name"), CASES)
def test_the_kernel_alone_holds(
    kind: str, name: str, crossing: Crossing, around: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class All(frozenset[str]):
        def __contains__(self, item: object) -> bool:
            return True

    def unchecked(document: Document) -> Document:
        return document

    def no_fault(option: str, value: str) -> str:
        return ""

    monkeypatch.setattr(scenario, "admitted", unchecked)
    monkeypatch.setattr(scenario, "OPTIONS", All())
    monkeypatch.setattr(settings, "OPTIONS", All())
    monkeypatch.setattr(settings, "option_fault", no_fault)
    path = hostile(crossing, kind, name, around)
    assert SECRET not in play(path)


@pytest.mark.skipif(bool(confinement_missing()), reason="only the list protects here")
@pytest.mark.parametrize("wrap", [None, "ugat_marl.envs.wrappers:pad_spaces"])
def test_the_kernel_holds_the_workers_of_a_vector(
    wrap: str | None, crossing: Crossing, around: Path
) -> None:
    path = hostile(crossing, "additional", "edgeData", around)
    honest = read_scenario(path)
    raw = honest.additional[0].edited((path.parent / "extra.add.xml").read_bytes())
    opened = replace(honest, additional=(raw,))
    with vector_env(opened, 1, wrap=wrap) as env:
        step = env.reset(seed=0)  # the worker reads the scenario again, and discards the output
        assert step.observations.shape[0] == 1
        worker = env._environments[0]._worker
        assert worker is not None
        status = Path(f"/proc/{worker._pid}/status").read_text()
        assert "NoNewPrivs:\t1" in status  # set with the rules of the kernel, and never before


EVIL = (
    '<routes><vehicle id="s" depart="0"><route edges="S_C C_N"/>'
    '<param key="has.ssm.device" value="true"/>'
    '<param key="device.ssm.file" value="{out}"/></vehicle></routes>'
)


@pytest.mark.parametrize("simulator", ["inprocess", "process"])
@pytest.mark.parametrize("name", ["${UNSET}evil.rou.xml", "none,evil.rou.xml", "none;evil.rou.xml"])
def test_sumo_reads_the_file_that_was_looked_through(
    name: str, simulator: str, crossing: Crossing, around: Path
) -> None:
    """SUMO puts variables into file names: it would read a hostile file under a harmless name."""
    directory = crossing()
    (directory / "demand.rou.xml").rename(directory / name)
    (directory / "evil.rou.xml").write_text(EVIL.format(out=around / "kept.txt"))
    settings_file = directory / "scenario.toml"
    settings_file.write_text(settings_file.read_text().replace("demand.rou.xml", name))
    assert play(directory, simulator) == ""


@pytest.mark.parametrize("name", ["trips.xml", "errors.log", "statistics.xml"])
def test_an_edited_file_with_the_name_of_an_output_is_read(name: str, crossing: Crossing) -> None:
    directory = crossing()
    (directory / name).write_text('<additional><edgeData id="d" file="x"/></additional>')
    settings_file = directory / "scenario.toml"
    settings_file.write_text(f'additional = ["{name}"]\n{settings_file.read_text()}')
    assert read_scenario(directory).additional[0].content is not None
    assert play(directory) == ""


def test_the_bait_works(crossing: Crossing, around: Path, tmp_path: Path) -> None:
    """Without list and kernel a hostile scenario overwrites the file: the tests can fail."""
    from ugat_marl.scenarios import Scenario
    from ugat_marl.simulation import LibsumoSimulator, launch_of

    path = hostile(crossing, "additional", "e1Detector", around)
    honest = read_scenario(path)
    raw = Document("extra.add.xml", path.parent / "extra.add.xml")
    opened = Scenario("x", honest.network, honest.routes, (raw,), honest.settings)
    simulator = LibsumoSimulator()
    simulator.start(launch_of(opened, 0, tmp_path / "run", ()))
    simulator.advance(20.0, {})
    simulator.close()
    shutil.rmtree(tmp_path / "run")
    assert (around / "kept.txt").read_text() != KEPT
    (around / "kept.txt").write_text(KEPT)


@pytest.mark.parametrize(
    ("option", "value", "fault"),
    [
        ("ignore-route-errors", "--summary=x", "neither true nor false"),
        ("scale", "1e9", "between 0 and 100"),
        ("meso-edgelength", "0.000001", "between 1 and 1e"),
        ("lateral-resolution", "1e-7", "between 0.01 and 100"),
        ("pedestrian.striping.stripe-width", "1e-8", "between 0.01 and 100"),
        ("scale", "nan", "not a number"),
        ("scale", "1_0", "not a number"),
        ("scale", "\u0661", "not a number"),
        ("routing-algorithm", "/etc/passwd", "not a plain word"),
        ("time-to-impatience", "soon", "not a number"),
    ],
)
def test_values_of_options(option: str, value: str, fault: str) -> None:
    raw = {"network": "n", "routes": ["r"], "sumo": {option: value}}
    with pytest.raises(UgatMarlError, match=fault):
        settings.validate_settings(raw, "here")


def test_a_pile_of_elements_is_refused(crossing: Crossing) -> None:
    directory = crossing()
    routes = directory / "demand.rou.xml"
    deep = "<person>" * 12000 + "</person>" * 12000
    routes.write_text(f"<routes>{deep}</routes>")
    with pytest.raises(UgatMarlError, match="line 1: more than 64 elements inside each other"):
        read_scenario(directory)


@pytest.mark.parametrize(
    ("vehicles", "extra", "fault"),
    [
        ('<flow id="a" begin="0" end="60" number="400000000" route="east"/>', "", "more than 1000"),
        ("", '<parkingArea id="p" lane="W_C_0" roadsideCapacity="400000000"/>', "more than 100000"),
        ('<route id="r" edges="W_C C_E" repeat="400000000"/>', "", "more than 10000"),
        ("", '<busStop id="p" lane="W_C_0" personCapacity="400000000"/>', "more than 100000"),
    ],
)
def test_numbers_that_fill_the_memory_are_refused(
    vehicles: str, extra: str, fault: str, crossing: Crossing
) -> None:
    directory = crossing(vehicles=vehicles or None)
    if extra:
        (directory / "extra.add.xml").write_text(f"<additional>{extra}</additional>")
        settings_file = directory / "scenario.toml"
        settings_file.write_text(f'additional = ["extra.add.xml"]\n{settings_file.read_text()}')
    with pytest.raises(UgatMarlError, match=rf"line \d+: <.* is {fault}"):
        read_scenario(directory)


def test_a_vaporizer_is_refused_since_its_vehicles_are_in_no_report(crossing: Crossing) -> None:
    directory = crossing(toml=lambda text: f'additional = ["a.add.xml"]\n{text}')
    (directory / "a.add.xml").write_text(
        '<additional><vaporizer id="W_C" begin="0" end="9"/></additional>'
    )
    with pytest.raises(ScenarioError, match="line 1: <vaporizer> removes vehicles"):
        read_scenario(directory)


@pytest.mark.parametrize("shortest", ["0", "-5", "0.0001", "0.0"])
def test_phases_that_never_end_are_refused(shortest: str, crossing: Crossing) -> None:
    """SUMO changes between actuated phases of no time without end, in one step."""
    directory = crossing()
    phases = "".join(f'<phase duration="9" minDur="{shortest}" state="{s}"/>' for s in ("rG", "Gr"))
    logic = f'<tlLogic id="C" type="actuated" programID="x" offset="0">{phases}</tlLogic>'
    (directory / "extra.add.xml").write_text(f"<additional>{logic}</additional>")
    settings_file = directory / "scenario.toml"
    settings_file.write_text(f'additional = ["extra.add.xml"]\n{settings_file.read_text()}')
    with pytest.raises(UgatMarlError, match=rf"<phase minDur='{shortest}'> is not a time above 0"):
        read_scenario(directory)


@pytest.mark.parametrize(("model", "segment"), [("true", ""), ("false", "98"), ("1", "98")])
def test_the_mesoscopic_model_is_whole_or_absent(
    model: str, segment: str, crossing: Crossing
) -> None:
    directory = crossing()
    with (directory / "scenario.toml").open("a") as file:
        file.write(f'[sumo]\nmesosim = "{model}"\n')
        file.write(f'meso-edgelength = "{segment}"\n' if segment else "")
    with pytest.raises(UgatMarlError, match=f"sumo.mesosim = '{model}': the mesoscopic model"):
        read_scenario(directory)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no limit of memory on Windows")
def test_the_limit_of_memory_alone_holds(
    crossing: Crossing, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the bounds of the list; SUMO's own words are on its standard error alone here."""
    monkeypatch.setattr(admission, "_MOST_OF", {})
    monkeypatch.setenv(MEMORY_VARIABLE, "0.5")
    directory = crossing()
    area = '<parkingArea id="p" lane="W_C_0" roadsideCapacity="400000000"/>'
    (directory / "extra.add.xml").write_text(f"<additional>{area}</additional>")
    settings_file = directory / "scenario.toml"
    settings_file.write_text(f'additional = ["extra.add.xml"]\n{settings_file.read_text()}')
    assert play(directory, "spawn").startswith("SUMO did not start: it needs more memory than")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no limit of memory on Windows")
@pytest.mark.parametrize("of", ["persons", "vehicles"])
def test_a_simulation_that_asks_for_all_memory_is_refused(
    of: str, crossing: Crossing, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beneath the limits of single numbers: persons that no number of a flow forbids.

    SUMO may read the memory that it did not get, and die, before it can say what was missing.
    """
    monkeypatch.setenv(MEMORY_VARIABLE, "0.3")
    vehicle = '<vehicle id="a" depart="0" route="east"/>'
    many = '<personFlow id="p" begin="0" end="60" number="9000000"><walk edges="W_C"/></personFlow>'
    if of == "vehicles":
        many = '<flow id="p" begin="0" end="60" number="9000000" route="east"/>'
    said = play(crossing(vehicles=vehicle + many), "spawn")
    told = r"needs more memory than .*\(0\.3 GB\)|died with status -11 .* out of memory\?"
    assert re.search(rf"({told}).*{MEMORY_VARIABLE}", said)
    assert play(crossing(vehicles=vehicle), "spawn") == ""


@pytest.mark.parametrize("text", ["all", "0", "-1", "nan", "inf"])
def test_impossible_limits_of_memory(
    text: str, crossing: Crossing, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(MEMORY_VARIABLE, text)
    assert f"{MEMORY_VARIABLE} = {text!r}: give a number" in play(crossing(), "spawn")


@pytest.mark.parametrize("attribute", ["length", "speed"])
@pytest.mark.parametrize("text", ["-5", "0", "inf", "nan", "1_000", "\u0661", "", "1e999"])
def test_lanes_that_no_vehicle_can_use_are_refused(
    attribute: str, text: str, crossing: Crossing
) -> None:
    directory = crossing()
    network = directory / "network.net.xml"
    before = network.read_text()
    after = re.sub(rf'(<lane [^>]*{attribute}=")[^"]*', rf"\g<1>{text}", before, count=1)
    assert after != before
    network.write_text(after)
    with pytest.raises(UgatMarlError, match=rf"line \d+: lane '.*' has {attribute} = .* above 0"):
        read_scenario(directory)


def test_a_request_outside_every_table_is_refused(crossing: Crossing) -> None:
    directory = crossing()
    network = directory / "network.net.xml"
    network.write_text(
        network.read_text().replace('<request index="0"', '<request index="400000000"')
    )
    with pytest.raises(UgatMarlError, match="line .*400000000.* is not a number from 0 to 4095"):
        read_scenario(directory)


@pytest.mark.parametrize("text", ["1_000", "\u0661", "nan", "inf", "1e999"])
@pytest.mark.parametrize("element", ["vehicle", "flow", "phase"])
def test_numbers_that_people_and_programs_read_differently_are_refused(
    element: str, text: str, crossing: Crossing
) -> None:
    elements = {
        "vehicle": f'<vehicle id="a" depart="{text}" route="east"/>',
        "flow": f'<flow id="a" begin="0" end="60" number="{text}" route="east"/>',
        "phase": '<vehicle id="a" depart="0" route="east"/>',
    }
    directory = crossing(vehicles=elements[element])
    if element == "phase":
        network = directory / "network.net.xml"
        network.write_text(network.read_text().replace('duration="10"', f'duration="{text}"'))
    with pytest.raises(UgatMarlError, match=rf"line \d+: <{element} \w+=.*in plain digits"):
        read_scenario(directory)


@pytest.mark.parametrize(
    ("text", "wrong"),
    [("1_0", "1_0"), ("\u0661", "\u0661"), ("nan:0:0", "nan"), ("0:1_0:0", "1_0"), ("", "")],
)
def test_times_are_plain_digits(text: str, wrong: str) -> None:
    with pytest.raises(ValueError, match=rf"^{wrong}$"):
        settings.parse_time(text)


def test_times_with_and_without_colons() -> None:
    assert settings.parse_time("1:02:03.5") == 3723.5
    assert settings.parse_time("1:00:00:01") == 86401.0
    assert settings.parse_time("12.25") == 12.25
