"""What a page says of a fitted street and of each intersection, from numbers by hand."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import pytest

import ugat_marl
from ugat_marl.data import Metrics
from ugat_marl.effects import load_scenario
from ugat_marl.policies import NamedRule
from ugat_marl.reporting.intersection_findings import findings_maps, findings_table
from ugat_marl.reporting.places import AgentPlaces
from ugat_marl.reporting.run_records import RunRecord
from ugat_marl.reporting.street_found import commands_found, detectors_found, found_on_street
from ugat_marl.scenarios import Network


def record(folder: Path, *iterations: dict[str, float]) -> RunRecord:
    rows = [
        ("iteration", number, name, value)
        for number, numbers in enumerate(iterations, 1)
        for name, value in numbers.items()
    ]
    nothing: dict[str, Any] = {}
    return RunRecord(
        "run", folder, False, nothing, nothing, nothing, None, Metrics(rows), None, None, (), 0.0
    )


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ({"channel/lag_0": 1.0, "channel/lost": 0.0}, "Commands: obeyed at once."),
        (
            {"channel/lag_0": 0.2, "channel/lag_1": 0.5, "channel/lost": 0.3},
            "Commands: 50 % take effect 1 decision late, 30 % are lost.",
        ),
        (
            {"channel/lag_2": 1.0, "channel/forbids": 1.0},
            "Commands: 100 % take effect 2 decisions late, some changes of phase are refused.",
        ),
    ],
)
def test_commands(numbers: dict[str, float], said: str, tmp_path: Path) -> None:
    assert commands_found(record(tmp_path / "run", numbers)) == said


def test_detectors(tmp_path: Path) -> None:
    none = dict.fromkeys(("dead", "zone_m", "absolute", "relative", "lag", "lost", "step"), 0.0)
    found = {f"eyes/{name}": value for name, value in none.items()}
    assert detectors_found(record(tmp_path / "a", found)) == "Detectors: no fault found."
    found |= {"eyes/zone_m": 21.4, "eyes/relative": 0.1}
    assert detectors_found(record(tmp_path / "b", found)) == (
        "Detectors: vehicles count only within 21 m of the stop line, counts err by 10 %."
    )
    assert detectors_found(record(tmp_path / "c", {})) == ""


def test_what_an_iteration_did_not_find_is_not_taken_from_the_one_before(tmp_path: Path) -> None:
    street = {"street/commands": 0.0, "eyes/dead": 0.0}
    late = {"channel/lag_2": 0.93, "channel/lost": 0.07, "channel/late_s/signal_0": 20.0}
    first = street | late | {"judged/before": 90.0, "judged/of_the_rival": 80.0}
    second = street | {"channel/lag_0": 1.0, "judged/before": 95.0, "judged/after": 90.0}
    run = record(tmp_path, first, second)
    section = found_on_street(run)
    assert section is not None
    assert section["commands"] == "Commands: obeyed at once."
    assert section["kept"].endswith("Kept was the policy after training.")
    assert findings_table(run, None) is None


def test_effects_and_the_policy_that_was_kept(tmp_path: Path) -> None:
    numbers = {
        "street/commands": 0.0,
        "effects/acceleration": 0.5,
        "effects/acceleration/low": 0.4,
        "effects/acceleration/high": 0.9,
        "effects/acceleration/nominal": 2.6,
        "effects/acceleration/chance": 0.97,
        "judged/before": 110.0,
        "judged/after": 102.0,
        "judged/of_the_rule": 99.0,
    }
    section = found_on_street(record(tmp_path / "run", numbers))
    assert section is not None
    (effect,) = section["effects"].rows
    assert effect == ["acceleration", "m/s^2", "2.6", "0.5", "0.4 to 0.9", "97%"]
    assert section["kept"].endswith(
        "the policy kept so far 110 s, the policy after training 102 s, the rule 99 s. "
        "Kept was the rule."
    )
    assert section["unlike"] == ""
    section = found_on_street(record(tmp_path, numbers | {"street/beyond_worlds": 0.45}))
    assert section is not None
    assert section["unlike"].startswith("The log is unlike every simulated world: 45% of its")
    kept = tmp_path / "run" / "policies" / "fitted-street.pt"
    kept.parent.mkdir(parents=True)
    with contextlib.closing(ugat_marl.parallel_env("single-v1")) as env:
        NamedRule("max-pressure:20", env).save(kept)
    section = found_on_street(record(tmp_path / "run", numbers))
    assert section is not None and section["kept"].endswith("Kept was the rule max-pressure:20.")
    kept.write_bytes(b"damaged")
    section = found_on_street(record(tmp_path / "run", numbers))
    assert section is not None and section["kept"].endswith("Kept was the rule.")
    assert found_on_street(record(tmp_path / "other", {"gate/alpha": 0.5})) is None


def with_ends(name: str, ends: dict[str, tuple[float, float, float]]) -> dict[str, float]:
    """Metrics of low end, number and high end of each agent."""
    return {
        f"{name}{suffix}/{agent}": value
        for agent, values in ends.items()
        for suffix, value in zip(("_low", "", "_high"), values, strict=True)
    }


def test_findings_at_each_intersection(tmp_path: Path) -> None:
    numbers = with_ends("unused/begin_s", {"signal_0": (0.5, 1.25, 2.0)})
    numbers |= with_ends("unused/each_s", {"signal_0": (0.0, 0.0, 0.31)})
    numbers |= with_ends("channel/missing", {"signal_0": (0.1, 0.2, 0.3), "signal_1": (0, 0, 0.1)})
    table = findings_table(record(tmp_path / "run", numbers), None)
    assert table is not None
    assert table.headings[2:] == [
        "commands that are lost, % (90 % interval)",
        "green unused at its beginning, s (90 % interval)",
        "green unused in each further decision, s (90 % interval)",
    ]
    assert table.rows == [
        ["signal_0", "–", "20 (10 to 30)", "1.2 (0.5 to 2)", "0 (0 to 0.31)"],
        ["signal_1", "–", "0 (0 to 10)", "–", "–"],
    ]
    assert findings_table(record(tmp_path / "other", {"gate/alpha/signal_0": 0.5}), None) is None


def test_delays_of_timed_grounding_have_their_interval(tmp_path: Path) -> None:
    numbers = {f"lost_time/{x}_s/signal_0": v for x, v in (("low", 2), ("best", 3), ("high", 3.5))}
    table = findings_table(record(tmp_path / "run", numbers), None)
    assert table is not None
    assert table.headings[2] == "delay of greens, s (95 % interval)"
    assert table.rows == [["signal_0", "–", "3 (2 to 3.5)"]]


def test_a_map_shows_each_number_with_its_interval(tmp_path: Path) -> None:
    scenario = load_scenario("grid2x2-v1")
    lights = {"signal_0": "A1", "signal_1": "A2", "signal_2": "B1", "signal_3": "B2"}
    places = AgentPlaces(Network.read(scenario), lights)
    late = {agent: (k - 0.5, float(k), k + 0.5) for k, agent in enumerate(lights, 1)}
    found = record(tmp_path / "run", with_ends("channel/late_s", late))
    ((picture, caption),) = findings_maps(found, places)
    assert picture is not None
    assert picture.name == "run-map-channel-late_s"
    assert caption == "Delay of commands at each intersection (in brackets the 90 % interval)."
    page = picture.for_page()
    for k, light in enumerate(lights.values(), 1):
        assert f"<title>{light}: {k} ({k - 0.5} to {k + 0.5}) s</title>" in page
        assert f">({k - 0.5} to {k + 0.5})<" in page
    alone = AgentPlaces(places.network, {"signal_0": "A1"})
    assert findings_maps(found, alone) == []
