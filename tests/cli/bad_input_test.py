"""Everything a user may hand over that is broken: one clear sentence, and no file is touched.

The sentence names the thing and the way out. Each case goes through the front door,
`ugat_marl.parallel_env`, as a user would.
"""

from __future__ import annotations

import gzip
import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from ugat_marl import parallel_env
from ugat_marl.__main__ import main
from ugat_marl.errors import (
    ActionError,
    EpisodeError,
    OptionError,
    ScenarioError,
    SimulatorError,
    UgatMarlError,
    UnknownNameError,
)

Crossing = Callable[..., Path]
Edit = Callable[[Path], object]


@dataclass(frozen=True)
class Case:
    """Something wrong with the crossing, and what a user is told about it.

    Attributes:
        name: What is wrong.
        spoil: Makes it wrong.
        says: Patterns the message must hold: the thing, and the way out.
        error: Its class.
    """

    name: str
    spoil: Edit
    says: tuple[str, ...]
    error: type[UgatMarlError] = ScenarioError


NETWORK, ROUTES, TOML = "network.net.xml", "demand.rou.xml", "scenario.toml"


def replaced(file: str, old: str, new: str, count: int = -1) -> Edit:
    def edit(directory: Path) -> None:
        text = (directory / file).read_text()
        assert old in text
        (directory / file).write_text(text.replace(old, new, count))

    return edit


def gone(file: str) -> Edit:
    return lambda directory: (directory / file).unlink()


def cut(file: str, keep: float) -> Edit:
    def edit(directory: Path) -> None:
        data = (directory / file).read_bytes()
        (directory / file).write_bytes(data[: int(keep * len(data))])

    return edit


def packed(file: str, keep: float) -> Edit:
    def edit(directory: Path) -> None:
        data = gzip.compress((directory / file).read_bytes())
        (directory / f"{file}.gz").write_bytes(data[: int(keep * len(data))])
        (directory / file).unlink()
        replaced(TOML, file, f"{file}.gz")(directory)

    return edit


def content(file: str, text: str | bytes) -> Edit:
    data = text.encode() if isinstance(text, str) else text
    return lambda directory: (directory / file).write_bytes(data)


def appended(text: str) -> Edit:
    def edit(directory: Path) -> None:
        with (directory / TOML).open("a") as file:
            file.write(text)

    return edit


def topped(text: str) -> Edit:
    return lambda directory: (directory / TOML).write_text(text + (directory / TOML).read_text())


def both(*edits: Edit) -> Edit:
    return lambda directory: [edit(directory) for edit in edits]


def additional(text: str) -> Edit:
    def edit(directory: Path) -> None:
        (directory / "more.add.xml").write_text(text)
        topped('additional = ["more.add.xml"]\n')(directory)

    return edit


LAUGHS = '<!DOCTYPE x [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]>'
CASES = [
    # files
    Case("no network file", gone(NETWORK), ("scenario.toml: network names", "does not exist")),
    Case("no route file", gone(ROUTES), ("scenario.toml: routes names", "does not exist")),
    Case("network cut short", cut(NETWORK, 0.6), (r"network\.net\.xml: not well-f", "cut short")),
    Case("routes cut short", cut(ROUTES, 0.6), (r"demand\.rou\.xml: not well-formed", "cut short")),
    Case("network empty", content(NETWORK, ""), (r"network\.net\.xml: ", "cut short")),
    Case("network is no XML", content(NETWORK, b"\x89PNG\r\n\x1a\n\0"), (r"network\.net\.xml: ",)),
    Case(
        "packed network cut short",
        packed(NETWORK, 0.7),
        (r"network\.net\.xml\.gz: not a whole gzip archive", "cut short"),
    ),
    Case(
        "packed routes cut short",
        packed(ROUTES, 0.7),
        (r"demand\.rou\.xml\.gz: not a whole gzip archive", "cut short"),
    ),
    Case(
        "entities in the network",
        replaced(NETWORK, "<net ", LAUGHS + "<net ", 1),
        (r"network\.net\.xml: document types and entities", "remove them"),
    ),
    Case(
        "entities in the routes",
        replaced(ROUTES, "<routes>", LAUGHS + "<routes>"),
        (r"demand\.rou\.xml: document types and entities", "remove them"),
    ),
    Case(
        "entities in an additional file",
        additional(LAUGHS + "<additional>&b;</additional>"),
        (r"more\.add\.xml: document types and entities", "remove them"),
    ),
    Case(
        "routes in the place of the network",
        replaced(TOML, "network.net.xml", ROUTES),
        (r"demand\.rou\.xml: a SUMO network begins with <net>, this with <routes>",),
    ),
    # network
    Case(
        "no traffic light",
        replaced(NETWORK, ' tl="C"', ""),
        (r"network\.net\.xml: no traffic light", "netconvert --tls.guess adds"),
    ),
    Case(
        "only one green phase",
        replaced(NETWORK, '<phase duration="10" state="rG"/>', ""),
        ("only traffic lights with fewer than two green phases", "netconvert"),
    ),
    Case(
        "no programme at all",
        lambda directory: (directory / NETWORK).write_text(
            re.sub("<tlLogic.*</tlLogic>", "", (directory / NETWORK).read_text(), flags=re.S)
        ),
        ("only traffic lights with fewer than two green phases",),
    ),
    Case(
        "listed phases that conflict",
        appended('[intersections.C]\nphases = ["GG", "rG"]\n'),
        ("traffic light 'C': phase", r"\('GG'\)", "write g for"),
    ),
    Case(
        "a state too short",
        replaced(NETWORK, 'state="Gr"', 'state="G"'),
        ("'C': state 0 of its programme", "has 1 letters, but it controls 2", "one letter per"),
    ),
    Case(
        "a state too long",
        replaced(NETWORK, 'state="rG"', 'state="rGr"'),
        ("'C': state 1 of its programme", "has 3 letters, but state 0 has 2", "one letter per"),
    ),
    Case(
        "a listed phase of the wrong length",
        appended('[intersections.C]\nphases = ["Gr", "rGG"]\n'),
        ("traffic light 'C': phase 1", "has 3 letters, but .* controls 2 links", "one letter per"),
    ),
    Case(
        "letters no signal has",
        replaced(NETWORK, 'state="rG"', 'state="rX"'),
        ("'C': state 1", r"unknown letters \['X'\]", "allowed:"),
    ),
    Case(
        "a listed phase without green",
        appended('[intersections.C]\nphases = ["Gr", "rr"]\n'),
        (r"phase 1 \('rr'\) has no green", "leave it out or give it one"),
    ),
    Case(
        "one listed phase",
        appended('[intersections.C]\nphases = ["Gr"]\n'),
        ("only traffic lights with fewer than two green phases",),
    ),
    Case(
        "a light that is not there",
        appended('[intersections.D]\nphases = ["Gr", "rG"]\n'),
        ("intersections.D is not a traffic light of", "it has: C"),
    ),
    Case(
        "a number that is none",
        replaced(NETWORK, 'length="490.00"', 'length="long"', 1),
        (r"network\.net\.xml, line 13: ", "'long'", "build the network again with netconvert"),
    ),
    Case(
        "a connection over a lane that is not there",
        replaced(NETWORK, 'toLane="0" via=":C_0_0"', 'toLane="7" via=":C_0_0"'),
        ("traffic light 'C'", "lane 'C_N_7'", "netconvert"),
    ),
    Case(
        "a link index that is none",
        replaced(NETWORK, 'linkIndex="1"', 'linkIndex="one"'),
        (r"network\.net\.xml: ", "'one'", "netconvert"),
    ),
    Case(
        "no right-of-way matrix, and phases to be derived from it",
        both(
            replaced(NETWORK, ' via=":C_0_0"', ""),
            replaced(TOML, '"programme"', '"conflict-free"'),
        ),
        ("traffic light 'C'", "no internal lanes", 'use phases = "programme" or list the phases'),
    ),
    # demand
    Case(
        "a route over an edge that does not exist",
        replaced(ROUTES, "W_C C_E", "W_C C_Q"),
        (r"demand\.rou\.xml, line \d+: <route id='east'>", "'C_Q'", "made for another network"),
    ),
    Case(
        "no vehicles",
        content(ROUTES, "<routes/>"),
        (r"demand\.rou\.xml: no vehicle departs between", "check begin_s and duration_s"),
    ),
    # scenario.toml
    Case("no TOML", content(TOML, "network = [\n"), (r"scenario\.toml: not valid TOML",)),
    Case("bytes that are no text", content(TOML, b"\xff\xfe"), (r"scenario\.toml: not UTF-8",)),
    Case("no key network", content(TOML, 'routes = ["a"]'), ("key 'network' is missing",)),
    Case("no key routes", content(TOML, 'network = "a"'), ("key 'routes' is missing",)),
    Case(
        "no route file at all",
        replaced(TOML, '["demand.rou.xml"]', "[]"),
        (r"routes = \[\]", "at least 1"),
    ),
    Case(
        "an unknown key",
        topped("duration = 3600\n"),
        (r"scenario\.toml: unknown key 'duration'; did you mean 'duration_s'\?",),
    ),
    Case(
        "an unknown key in a table",
        appended("yelow_s = 3\n"),
        (r"scenario\.toml: unknown key 'control\.yelow_s'; did you mean 'yellow_s'\?",),
    ),
    Case(
        "a key like no other",
        topped("qqq = 1\n"),
        ("unknown key 'qqq'; known: description, network, routes",),
    ),
    Case(
        "an unknown key of an intersection",
        appended('[intersections.C]\nphase = "programme"\n'),
        ("unknown key 'intersections.C.phase'", "did you mean 'phases'"),
    ),
    Case(
        "an unknown source of phases",
        replaced(TOML, '"programme"', '"programm"'),
        ("control.phases: give 'programme', 'conflict-free', 'permitted', or a list",),
    ),
    Case(
        "a duration of nothing",
        replaced(TOML, "duration_s = 200", "duration_s = 0"),
        ("duration_s = 0", "greater than 0"),
    ),
    Case(
        "a duration without end",
        replaced(TOML, "duration_s = 200", "duration_s = inf"),
        ("duration_s = inf", "finite"),
    ),
    Case(
        "a begin before the beginning",
        topped("begin_s = -1\n"),
        ("begin_s = -1", "greater than or equal to 0"),
    ),
    Case(
        "a negative yellow",
        replaced(TOML, "yellow_s = 0", "yellow_s = -3"),
        ("control.yellow_s = -3", "greater than or equal to 0"),
    ),
    Case(
        "a number in words",
        replaced(TOML, "yellow_s = 0", 'yellow_s = "three"'),
        ("control.yellow_s = 'three'", "valid number"),
    ),
    Case(
        "a yellow no step length divides",
        replaced(TOML, "yellow_s = 0", "yellow_s = 2.5"),
        ("control.yellow_s = 2.5 is not a multiple of step_length_s = 1",),
    ),
    Case(
        "an episode shorter than a decision",
        replaced(TOML, "duration_s = 200", "duration_s = 5"),
        ("duration_s = 5 is shorter than one decision interval",),
    ),
    Case(
        "an option of SUMO that is the suite's own",
        appended('[sumo]\nseed = "3"\n'),
        ("sumo.seed is set by the suite", "leave it out"),
    ),
    Case(
        "an unknown effect",
        appended('[[effects]]\nname = "startup_dely"\nseconds = 1\n'),
        ("unknown effect 'startup_dely'", "mean 'startup_delay'", "It stands in scenario 'cross"),
        UnknownNameError,
    ),
    Case(
        "an effect out of range",
        appended('[[effects]]\nname = "startup_delay"\nseconds = 100\n'),
        ("effect 'startup_delay': seconds = 100 is outside",),
        OptionError,
    ),
    Case(
        "an effect without its value",
        appended('[[effects]]\nname = "startup_delay"\n'),
        ("effect 'startup_delay' in scenario .*: parameter 'seconds' is missing",),
        OptionError,
    ),
]


def contents(directory: Path) -> dict[Path, bytes]:
    return {file: file.read_bytes() for file in directory.rglob("*") if file.is_file()}


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_broken_scenario(case: Case, crossing: Crossing) -> None:
    directory = crossing()
    case.spoil(directory)
    before = contents(directory)
    with pytest.raises(case.error) as caught:
        parallel_env(directory)
    message = str(caught.value)
    for pattern in case.says:
        assert re.search(pattern, message), message
    assert_one_sentence(message)
    assert contents(directory) == before


def assert_one_sentence(message: str) -> None:
    assert "\n" not in message
    assert "Traceback" not in message
    assert not re.search(r"pydantic|KeyError|ValueError|NoneType|object at 0x", message), message
    assert 20 < len(message) < 600, message


REFUSED_BY_SUMO = [
    (
        '<vehicle id="v" type="car" route="nowhere" depart="0"/>',
        ("SUMO did not start", "route 'nowhere'"),
    ),
    ('<vehicle id="v" type="ship" route="east" depart="0"/>', ("SUMO did not start", "'ship'")),
    ('<trip id="v" depart="0" from="W_C" to="C_N"/>', ("SUMO", "'v'", "no valid route")),
    ('<vehicle id="v" depart="0"><route edges="W_C C_N"/></vehicle>', ("SUMO", "'v'", "no valid")),
]


@pytest.mark.parametrize(("vehicles", "says"), REFUSED_BY_SUMO)
def test_what_only_sumo_can_know_is_told_in_its_words(
    vehicles: str, says: tuple[str, ...], crossing: Crossing
) -> None:
    env = parallel_env(crossing(vehicles=vehicles))

    def run() -> None:
        env.reset(seed=0)
        env.step({"signal_0": 0})

    with pytest.raises(SimulatorError) as caught:
        run()
    for pattern in says:
        assert re.search(pattern, str(caught.value)), str(caught.value)
    assert_one_sentence(str(caught.value))
    env.close()


# --- names


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("grid4x4", "unknown scenario 'grid4x4'. Did you mean 'grid4x4-v1'?"),
        ("grid4x4-v9", "Did you mean 'grid4x4-v1'?"),
        ("Single-V1", "Did you mean 'single-v1'?"),
        ("", "unknown scenario ''"),
        ("no/such/place", "A directory, a .sumocfg file and resco:<map> work as well."),
    ],
)
def test_an_unknown_scenario(name: str, says: str) -> None:
    with pytest.raises(UnknownNameError, match=re.escape(says)):
        parallel_env(name)


def test_a_directory_that_is_no_scenario(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="a directory without scenario.toml is not a scenario"):
        parallel_env(tmp_path)


def test_a_sumocfg_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"city\.sumocfg: no such file"):
        parallel_env(tmp_path / "city.sumocfg")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"domain": "V7"}, r"unknown domain 'V7'\. Did you mean 'V[1-4]'"),
        ({"domain": "rian"}, r"unknown domain 'rian'\. Did you mean 'rain'"),
        ({"observation": "cuont"}, r"'cuont'.* Did you mean 'count'"),
        ({"reward": "preassure"}, r"'preassure'.* Did you mean 'pressure'"),
        ({"simulator": "procces"}, r"'procces'.* Did you mean 'process'"),
        ({"signals": "action"}, r"'action'.* Did you mean 'actions'"),
        ({"render_mode": "rgb"}, r"'rgb'.* Did you mean 'rgb_array'"),
        ({"rewrad": "queue"}, r"unknown option 'rewrad'\. Did you mean 'reward'"),
    ],
)
def test_unknown_names_are_told_the_nearest(options: dict[str, str], says: str) -> None:
    with pytest.raises(UnknownNameError, match=says):
        parallel_env("single-v1", **options)


@pytest.mark.parametrize(
    "options", [{"duration_s": 0}, {"duration_s": -5}, {"duration_s": 3}, {"neighbours": -1}]
)
def test_impossible_options(options: dict[str, float]) -> None:
    with pytest.raises(UgatMarlError) as caught:
        parallel_env("single-v1", **options)
    (name,) = options
    assert name in str(caught.value)
    assert_one_sentence(str(caught.value))


# --- demand that never enters


@pytest.fixture
def blocked(crossing: Crossing) -> Path:
    """Cars that may only depart where a stop line is, in a lane that is always full."""
    stand = '<vehicle id="{}" type="car" route="east" depart="{}" departPos="490" departSpeed="0"/>'
    return crossing(vehicles="".join(stand.format(n, 10 * n) for n in range(5)))


def test_demand_that_never_enters_is_a_warning(crossing: Crossing) -> None:
    late = '<vehicle id="v" type="car" route="east" depart="150"/>'
    env = parallel_env(crossing(vehicles=late), simulator="inprocess")
    env.reset(seed=0)
    env.step({"signal_0": 0})
    with pytest.warns(UserWarning, match="no vehicle has entered .* first 20 s .*check depart"):
        env.step({"signal_0": 0})  # a tenth of the episode
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # once is enough
        while env.agents:
            env.step({"signal_0": 0})
    assert env.scores().departed == 1
    env.close()


def test_demand_that_enters_is_none(crossing: Crossing) -> None:
    env = parallel_env(crossing(), simulator="inprocess")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.reset(seed=0)
        while env.agents:
            env.step({"signal_0": 0})
    env.close()


def test_the_backlog_is_in_the_scores(blocked: Path) -> None:
    env = parallel_env(blocked, simulator="inprocess")
    env.reset(seed=0)
    while env.agents:
        env.step({"signal_0": 0})
    scores = env.scores()
    assert (scores.due, scores.departed, scores.backlog) == (5, 1, 4)
    env.close()


# --- actions and moments


@pytest.fixture
def env(crossing: Crossing) -> Iterator[object]:
    made = parallel_env(crossing(), simulator="inprocess")
    yield made
    made.close()


@pytest.mark.parametrize(
    ("actions", "says"),
    [
        ({"signal_0": 2}, "action of agent 'signal_0' is 2; allowed: the integers 0 to 1"),
        ({"signal_0": -1}, "is -1; allowed: the integers 0 to 1"),
        ({"signal_0": 0.5}, "is 0.5; allowed: the integers"),
        ({"signal_0": None}, "is None; allowed: the integers"),
        ({}, "no action for agent 'signal_0'"),
        ({"signal_0": 0, "signal_1": 0}, r"unknown agents \['signal_1'\]; agents: \['signal_0'\]"),
    ],
)
def test_a_bad_action_changes_nothing(actions: dict[str, int], says: str, env: object) -> None:
    env.reset(seed=0)  # type: ignore[attr-defined]
    with pytest.raises(ActionError, match=says):
        env.step(actions)  # type: ignore[attr-defined]
    env.step({"signal_0": 1})  # type: ignore[attr-defined]
    assert env.snapshot.time_s == 10  # type: ignore[attr-defined]


def test_calls_at_the_wrong_moment(env: object) -> None:
    with pytest.raises(EpisodeError, match=r"call reset\(\) first"):
        env.step({"signal_0": 0})  # type: ignore[attr-defined]
    with pytest.raises(EpisodeError, match=r"before the first reset\(\)"):
        env.state()  # type: ignore[attr-defined]
    env.reset(seed=0)  # type: ignore[attr-defined]
    with pytest.raises(EpisodeError, match="whole episode of 20 steps"):
        env.scores()  # type: ignore[attr-defined]


def test_a_file_that_is_no_scenario_is_not_called_an_unknown_name(tmp_path: Path) -> None:
    (tmp_path / "trips.xml").write_text("<routes/>")
    with pytest.raises(ScenarioError, match=r"trips\.xml: is no scenario; give a directory"):
        parallel_env(tmp_path / "trips.xml")


@pytest.mark.parametrize("was_there", [False, True])
def test_an_interrupted_recording_leaves_no_new_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, was_there: bool
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("ugat_marl.cli.record.record", interrupted)
    if was_there:
        (tmp_path / "measured").mkdir()
    assert main(["record", "single-v1", "--out", str(tmp_path / "measured")]) == 130
    assert (tmp_path / "measured").exists() == was_there
