"""Effects rewrite route files piece by piece: the same bytes as ever, in little memory."""

from __future__ import annotations

import copy
import gc
import hashlib
import json
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from studies.blind.outside_effects import BusStops, Driveway
from ugat_marl.effects import (
    apply_effects,
    load_scenario,
    parse_domain,
    scenario_in_domain,
    shift_parking,
)
from ugat_marl.envs import parallel_env
from ugat_marl.errors import OutputError, ScenarioError
from ugat_marl.progress import Silent, showing
from ugat_marl.scenarios import Scenario

Crossing = Callable[..., Path]

DIGESTS = Path(__file__).parents[1] / "fixtures" / "effects-digests.json"
"""What each domain made of each scenario when whole files were edited in memory."""

CITY = """
<route id="far" edges="S_C C_N"><param key="a" value="b &lt; &#233;&#10;"/></route>
<routeDistribution id="either" routes="north far" probabilities="1 2"/>
<!-- comments are dropped -->
<vehicle id="v1" depart="triggered" type="mix" route="either"/>
<vehicle id="v2" depart="0:00:10" type="mix" route="east" speedFactor="1.2"><stop lane="C_E_0"
    endPos="50" duration="5"/><param key="k" value="v">some <param key="i"/> text</param></vehicle>
<flow id="f1" begin="20" end="180" vehsPerHour="400" type="car" route="north"/>
<trip id="t1" depart="30" from="W_C" to="C_E"/>
<flow id="f2" begin="40" number="30" period="exp(0.25)" from="W_C" to="C_E"/>
<person id="p" depart="45"><walk edges="S_C C_N"/></person>
<flow id="f3" begin="50" end="150" probability="0.6" route="east"/>
<vehicle id="v3+1" depart="60" route="north"/>
<flow id="f4" begin="70" end="90" number="7" route="east"/>
"""
TYPES = """<vType id="lorry" vClass="truck" tau="1.4"/><vType id="tram" vClass="tram"/>
<vTypeDistribution id="mix"><vType id="fast" vClass="passenger" probability="0.5"
    speedFactor="normc(1.1,0.2)"><carFollowing-IDM accel="2" tau="0.9"/></vType>
    <vType id="slow" vClass="passenger" probability="0.5"/></vTypeDistribution>"""

PLACES = {
    "single-v1": ("east1_A1", "A1_southA", "A1_east1_0"),
    "mixed-v1": ("Q_R", "R_V", "Q_R_0"),
    "crossing": ("W_C", "C_E", "C_E_0"),
}
"""An edge, one that follows it, and a lane."""

EVERYWHERE = (
    "V1", "V2", "V3", "V4",
    "demand_level=*,1.15", "demand_level=*,0.7", "demand_level=*,2.6",
    "demand_surge=*,60,130,1.7", "demand_timing=*,-45", "demand_timing=*,45",
    "heavy_share=0.3", "desired_speed=0.8", "speed_spread=0.2", "driver_model=IDM",
    "headway=1.5", "reaction_step=1.6", "red_running=2", "lane_discipline=0.2",
    "demand_level=*,1.4+demand_level=*,1.3+heavy_share=0.25+demand_timing=*,30+V4",
)  # fmt: skip
THERE = (
    "demand_level={0},1.8", "demand_level={0},0.4", "demand_surge={0},30,90,3",
    "demand_timing={0},100", "turning={0},{1},0.6", "turning={0},{1},0.5+demand_level={0},1.5",
    "parking={2},30,20+demand_level=*,1.2", "lane_closure={2},50,150+heavy_share=0.1",
)  # fmt: skip


def digest(scenario: Scenario) -> str:
    """The names and bytes of all files but the network."""
    found = hashlib.sha256()
    for document in (*scenario.routes, *scenario.additional):
        found.update(f"\0{document.name}\0".encode())
        found.update(document.read())
    return found.hexdigest()[:16]


def made(scenario: Scenario, name: str) -> dict[str, str]:
    """Every domain to the digest of what it makes of the scenario."""
    edge, following, lane = PLACES[name]
    domains = [*EVERYWHERE, *(text.format(edge, following, lane) for text in THERE)]
    found = {
        domain: digest(apply_effects(scenario, parse_domain(domain)))
        for domain in domains
        if name != "crossing" or not domain.startswith("turning")  # there is nowhere to turn to
    }
    parked = apply_effects(scenario, parse_domain(f"parking={lane},60,20"))
    found["parked at other times"] = digest(shift_parking(parked, 3))
    found["driveway"] = digest(Driveway(edge, 0.3).apply(scenario))
    if name != "crossing":  # buses go the usual way of vehicles with routes of their own
        found["bus stops"] = digest(BusStops(edge, 10, 20).apply(scenario))
    return found


def loaded(name: str, crossing: Crossing) -> Scenario:
    return load_scenario(crossing(vehicles=CITY, types=TYPES) if name == "crossing" else name)


@pytest.mark.parametrize("name", list(PLACES))
def test_the_same_files_as_ever(name: str, crossing: Crossing) -> None:
    expected = json.loads(DIGESTS.read_text(encoding="utf-8"))[name]
    assert made(loaded(name, crossing), name) == expected


def test_the_same_files_in_small_pieces(
    crossing: Crossing, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Read 300 bytes at a time, sorted in runs of a few vehicles, kept in files."""
    for limit, size in {"files._PIECE": 300, "files._KEPT": 900}.items():
        monkeypatch.setattr(f"ugat_marl.{limit}", size)
    monkeypatch.setattr("ugat_marl.effects.documents._RUN", 1000)
    expected = json.loads(DIGESTS.read_text(encoding="utf-8"))["crossing"]
    scenario = loaded("crossing", crossing)
    assert all(item.home for item in scenario_in_domain(scenario, "demand_level=*,1.2").routes)
    assert made(scenario, "crossing") == expected


def long(directory: Path, *, end: str = "</routes>") -> Path:
    """A megabyte and more of vehicles in the place of a scenario's demand."""
    line = '<vehicle id="v{0}" depart="{1:.3f}"><route edges="W_C C_E"/></vehicle>\n'
    text = "".join(line.format(i, i / 100) for i in range(17_000))
    (directory / "demand.rou.xml").write_text(f'<routes><vType id="car"/>\n{text}{end}')
    return directory


@pytest.mark.parametrize("domain", ["V4", "demand_level=*,1.15", "heavy_share=0.3"])
def test_a_long_file_is_never_in_memory(
    domain: str, crossing: Crossing, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As trees its vehicles are seven times as much as the file, and every limit is a tenth."""
    limits = {"files._PIECE": 1 << 15, "files._KEPT": 1 << 15, "effects.documents._RUN": 1 << 17}
    for limit, size in limits.items():
        monkeypatch.setattr(f"ugat_marl.{limit}", size)
    scenario = load_scenario(long(crossing()))
    tracemalloc.start()
    try:
        changed = scenario_in_domain(scenario, domain)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 1.5 * sum(map(len, scenario.routes[0].pieces()))
    assert changed.routes[0].home is not None


def test_what_is_kept_in_a_file_goes_with_the_scenario(
    crossing: Crossing, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("ugat_marl.files._KEPT", 1000)
    scenario = scenario_in_domain(load_scenario(crossing(vehicles=CITY, types=TYPES)), "V4")
    (route,) = scenario.routes
    assert route.path is not None
    content, path = route.path.read_bytes(), route.path
    copied = copy.deepcopy(scenario)  # as it is sent to another process
    written = load_scenario(scenario.write(tmp_path / "written"))
    assert "demand.rou.xml" in route.source
    assert str(path) not in route.source
    env = parallel_env(scenario, "sim", duration_s=20)
    try:
        env.reset(seed=1)
        assert not env.snapshot.backlog
    finally:
        env.close()
    del scenario, route, env
    gc.collect()
    assert not path.parent.exists()
    assert copied.routes[0].read() == content
    assert written.routes[0].read() == content
    assert written.hash == copied.hash


@pytest.mark.parametrize(
    ("end", "message"),
    [
        ("</routes", r"demand\.rou\.xml: not well-formed XML \(.*line 17002"),
        ("<route", r"demand\.rou\.xml: not well-formed XML \(.*line 17002"),
    ],
)
def test_a_file_cut_short_is_refused_with_its_line(
    end: str, message: str, crossing: Crossing
) -> None:
    with pytest.raises(ScenarioError, match=message):
        scenario_in_domain(load_scenario(long(crossing(), end=end)), "V4")


@pytest.mark.parametrize(
    "start", ['<!DOCTYPE r [<!ENTITY a "aa">]>', '<!DOCTYPE r SYSTEM "file:///etc/passwd">']
)
def test_entities_are_refused_with_their_line(start: str, crossing: Crossing) -> None:
    directory = crossing()
    text = f"<!-- one -->\n{start}\n<routes><vType id='&a;'/></routes>"
    (directory / "demand.rou.xml").write_text(text)
    with pytest.raises(ScenarioError, match=r"demand\.rou\.xml: .* entities .* \(line 2\)"):
        scenario_in_domain(load_scenario(directory), "V4")


@pytest.mark.parametrize("limit", ["files._KEPT", "effects.documents._RUN"])
def test_no_room_for_temporary_files(
    limit: str, crossing: Crossing, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(f"ugat_marl.{limit}", 1000)
    scenario = load_scenario(long(crossing()))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "none"))
    with pytest.raises(OutputError, match=r"none: cannot hold .* \(No such file.*TMPDIR"):
        scenario_in_domain(scenario, "demand_level=*,1.15")


def test_long_work_is_shown(crossing: Crossing, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ugat_marl.progress._PATIENCE_S", -1)
    told: list[tuple[str, int]] = []

    class Listening(Silent):
        def task(self, name: str, total: int) -> Any:
            told.append((name, total))
            return super().task(name, total)

    scenario = load_scenario(long(crossing()))
    with showing(Listening()):
        scenario_in_domain(scenario, "V4")
    assert told == [("MiB of demand.rou.xml", 1)]
    scenario_in_domain(scenario, "V4")
    assert len(told) == 1, "a library says nothing by itself"
