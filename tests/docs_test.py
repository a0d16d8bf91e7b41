"""What the pages promise is what the code does."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from ugat_marl.effects import effect_from
from ugat_marl.scenario_settings import (
    ControlSettings,
    IntersectionSettings,
    ScenarioFile,
    validated,
)

PAGE = (Path(__file__).parent.parent / "docs" / "scenario-file.md").read_text()


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
    settings = validated(tomllib.loads(example[1]), "docs/scenario-file.md")
    assert settings.intersections["C1"].phases == ("GGrr", "rrGG")
    for record in settings.effects:
        effect_from(record)
