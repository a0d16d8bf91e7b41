"""docs/reference/rules.md lists the rules as the code has them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ugat_marl.policies import RULE_NAMES, RULES, STANDARD_RULES, parse_rule

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "rules.md").read_text(encoding="utf-8")
ROWS = dict(re.findall(r"^\| `([\w-]+)` \| ([^|]+) \|$", PAGE, flags=re.MULTILINE))


def test_every_rule_has_a_row_and_a_paragraph() -> None:
    assert list(ROWS) == list(RULE_NAMES)
    told = re.findall(r"^- \*\*`([\w-]+)`\*\*", PAGE, flags=re.MULTILINE)
    assert sorted(told) == sorted(set(RULE_NAMES) - {"programme", "random"})


@pytest.mark.parametrize("name", RULE_NAMES)
def test_the_row_says_names_defaults_and_what_tuning_tries(name: str) -> None:
    numbers = [
        f"{parameter.default:g}; {', '.join(f'{value:g}' for value in parameter.choices)}"
        for parameter in RULES[name].parameters
    ]
    assert re.findall(r"\(([\d.,; ]+)\)", ROWS[name]) == numbers
    for parameter in RULES[name].parameters:
        assert parameter.name in ROWS[name]


def test_the_commands_name_rules_that_exist() -> None:
    (line,) = re.findall(r"--policies ([^-]\S*(?: [a-z]\S*)*) --domains", PAGE)
    for spec in line.split():
        parse_rule(spec)


def test_the_cost_of_the_search_is_the_one_on_the_page() -> None:
    rules = len(STANDARD_RULES)
    assert rules == 14
    assert f"fourteen rules cost {rules + (rules + 1) // 2} episodes" in PAGE.replace("\n", " ")
