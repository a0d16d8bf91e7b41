"""What the pages promise is what the code does."""

from __future__ import annotations

import re
import shlex
import tomllib
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import supersuit
from gymnasium.spaces import Box

import ugat_marl
from ugat_marl.__main__ import main
from ugat_marl.data import Scores
from ugat_marl.effects import (
    OBJECTIVES,
    BlockerPatience,
    Incident,
    QueueModel,
    effect_from_record,
    known_effects,
    measurement_effects,
)
from ugat_marl.effects.actuators import PHASE_ORDERS
from ugat_marl.effects.table import ON_CONTROLLERS
from ugat_marl.envs import OBJECTIVE_MEASURES
from ugat_marl.envs.observations import OBSERVATION_UNITS
from ugat_marl.envs.options import EnvOptions
from ugat_marl.envs.rewards import RewardName
from ugat_marl.files import xml_bytes
from ugat_marl.grounding import UNCERTAINTY_METHODS, FitConfig
from ugat_marl.scenarios import validate_settings
from ugat_marl.scenarios.settings import ControlSettings, IntersectionSettings, ScenarioFile

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "reference" / "scenario-file.md").read_text()
HOW_TO = (DOCS / "how-to" / "scenarios.md").read_text()


def test_every_key_of_a_scenario_file_is_documented() -> None:
    written = set(re.findall(r"^\| `([\w.<>]+)` \|", PAGE, flags=re.MULTILINE))
    keys = set(ScenarioFile.model_fields) - {"control", "intersections", "sumo"}
    keys |= {f"control.{name}" for name in ControlSettings.model_fields}
    keys |= {f"intersections.<id>.{name}" for name in IntersectionSettings.model_fields}
    assert written == keys | {"sumo.<option>"}


def test_the_defaults_on_the_page_are_those_of_the_code() -> None:
    rows = re.findall(
        r"^\| `control\.(\w+)` \| [^|]+ \| s \| ([\d.]+) \|", PAGE, flags=re.MULTILINE
    )
    assert len(rows) == 5
    for name, value in rows:
        assert getattr(ControlSettings(), name) == float(value)


def test_the_example_is_a_scenario_file() -> None:
    example = re.search(r"```toml\n(.*?)```", PAGE, flags=re.DOTALL)
    assert example is not None
    settings = validate_settings(tomllib.loads(example[1]), "docs/reference/scenario-file.md")
    assert settings.intersections["C1"].phases == ("GGrr", "rrGG")
    for record in settings.effects:
        effect_from_record(record)


def test_what_is_added_in_ten_lines_works(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    section = HOW_TO.partition("## Adding something")[2]
    blocks = re.findall(r"```(\w+)\n(.*?)```", section, flags=re.DOTALL)
    assert [kind for kind, _ in blocks] == ["sh", "python", "python", "python"]
    assert all(len(text.splitlines()) <= 10 for _, text in blocks)
    for line in blocks[0][1].splitlines():
        program, *words = shlex.split(line)
        assert program == "ugat-marl"
        assert main(words) == 0
    given = {"np": np, "replace": replace, "supersuit": supersuit, "Box": Box} | {
        "dataclass": dataclass, "ugat_marl": ugat_marl, "xml_bytes": xml_bytes,
    }  # fmt: skip
    made = [dict(given) for _ in blocks[1:]]
    for names, (_, text) in zip(made, blocks[1:], strict=True):
        exec(text, names)  # the page's own words, in a namespace of their own
    effect, observation, reward = made
    whole = reward["env"].demand.vehicles
    assert effect["env"].demand.vehicles == pytest.approx(0.75 * whole, abs=1)
    observations, _ = observation["seen"].reset(seed=1)
    for agent, vector in observations.items():
        assert vector[-1] == 0.0
        assert observation["seen"].observation_space(agent).contains(vector)
        assert len(vector) == observation["env"].observation_space(agent).shape[0] + 1
    env = reward["env"]
    env.reset(seed=1)
    for _ in range(6):
        _, rewards, *_ = env.step(dict.fromkeys(env.agents, 0))
        lanes = env.network.lane_table()
        for agent, value in rewards.items():
            own = env.network.intersection(env.intersection_of[agent]).incoming_lanes
            assert value == -env.snapshot.halting[lanes.indices(own)].max()
    for names in made:
        names["env"].close()


def test_the_example_of_drawn_networks_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    section = HOW_TO.partition("### Networks drawn from a seed")[2]
    example = re.search(r"```python\n(.*?)```", section, flags=re.DOTALL)
    assert example is not None
    names: dict[str, Any] = {}
    exec(example[1], names)  # the page's own words, in a namespace of their own
    assert [town.id for town in names["towns"]] == ["town0", "town1"]
    assert 0 < names["busiest"] < 0.8


def test_the_page_of_the_environment_says_what_the_code_does() -> None:
    page = (DOCS / "reference" / "environment.md").read_text()
    observations, rewards, ends, options = (
        page.partition(head)[2].partition("\n\n- ")[0].partition("\n## ")[0]
        for head in ("## Observations", "## Rewards", "## Infos", "## Options")
    )
    assert dict(re.findall(r"^\| `(\w+)`[^|]* \| ([^|]+) \|", observations, re.MULTILINE)) == {
        "observation": "features, one per lane",
        **OBSERVATION_UNITS,
    }
    assert f"`{EnvOptions().observation}` (default)" in observations
    named = re.findall(r"^\| `([\w-]+)`", rewards, re.MULTILINE)
    assert sorted(named) == sorted(["reward", *get_args(RewardName)])
    assert f"`{EnvOptions().reward}` (default)" in rewards
    measured = set(re.findall(r"`(\w+)`", ends.partition("| field |")[2]))
    assert measured == {field.name for field in fields(Scores)}
    told = options.partition("| option |")[2].partition("\n\n")[0]
    first = [row.split("|")[1] for row in told.splitlines()[2:]]
    assert {name for cell in first for name in re.findall(r"`(\w+)`", cell)} == {
        field.name for field in fields(EnvOptions)
    }


def test_every_uncertainty_is_documented() -> None:
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "training.md").read_text()
    table = page.partition("| `--fit.uncertainty` |")[2].partition("\n\n")[0]
    assert tuple(re.findall(r"^\| `(\w+)`", table, flags=re.MULTILINE)) == UNCERTAINTY_METHODS
    assert f"`{FitConfig().uncertainty}` (default)" in table


def test_every_effect_is_documented_with_its_fields_and_ranges() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "effects.md").read_text()
    rows = dict(re.findall(r"^\| `(\w+)` \| ([^|]+) \|", page, flags=re.MULTILINE))
    kinds = {**known_effects(), **measurement_effects()}
    assert list(rows) == list(kinds)
    for name, kind in kinds.items():
        cell = rows[name]
        assert re.findall(r"`(\w+)`", cell) == [item.name for item in fields(kind)], name
        for parameter in kind.ranges.values():
            if parameter.high < 1e6:  # a time of the scenario has no range worth a mention
                ends = (f"±{parameter.high:g}", f"{parameter.low:g}–{parameter.high:g}")
                assert any(text in cell for text in ends), (name, parameter)
            assert parameter.unit.replace("^2", "²") in cell
        for text in kind.texts.values():
            assert ("`*`" in cell) == text.everywhere or len(kind.texts) > 1
    example = re.search(r"```toml\n(.*?)```", page, flags=re.DOTALL)
    assert example is not None
    (record,) = tomllib.loads(example[1])["effects"]
    effect_from_record(record)


def test_every_effect_on_controllers_is_documented_with_its_fields_and_ranges() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "domains.md").read_text()
    rows = dict(re.findall(r"^\| `(\w+)` \| ([^|]+) \|", page, flags=re.MULTILINE))
    others = {kind.name: kind for kind in (Incident, QueueModel, BlockerPatience)}
    for name, kind in {**ON_CONTROLLERS, **others}.items():
        cell = rows[name]
        assert re.findall(r"`(\w+)`", cell) == [item.name for item in fields(kind)], name
        for parameter in kind.ranges.values():
            if parameter.high < 1e6:
                assert f"{parameter.low:g}–{parameter.high:g}" in cell, (name, parameter)
            assert parameter.unit in cell
    for rule in PHASE_ORDERS:
        assert f"`{rule}`" in page
    for name in OBJECTIVE_MEASURES:
        assert f"| `{name}` |" in page
    for name in OBJECTIVES:
        assert name in rows["objective"]
    example = re.search(r"```toml\n(.*?)```", page, flags=re.DOTALL)
    assert example is not None
    (record,) = tomllib.loads(example[1])["effects"]
    effect_from_record(record)
