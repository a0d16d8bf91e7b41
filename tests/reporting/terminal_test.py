"""Tables of the terminal: whole words in 80 columns, and both names of a light."""

from __future__ import annotations

import io
import math
from pathlib import Path

import pytest
from rich.console import Console, RenderableType

from ugat_marl.cli.plan import plan_table
from ugat_marl.effects import load_scenario
from ugat_marl.reporting import LightNames, control_delay_table, titled_table
from ugat_marl.reporting.terminal import named_table
from ugat_marl.scenarios import Network, SignalPlan, read_plans

TODAY = Path(__file__).parents[2] / "docs" / "tutorials" / "town" / "today.csv"


def lines_of(table: RenderableType, width: int = 80) -> list[str]:
    """The lines of a table in a terminal."""
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(table)
    return console.export_text().splitlines()


def test_lines_break_between_words_as_long_as_words_have_room() -> None:
    table = titled_table("Words")
    for heading in ("light", "movements", "split"):
        table.add_column(heading, overflow="fold")
    table.add_row("cluster_2_5", "NBR NBT NBL SBR SBT SBL", "45")
    lines = lines_of(table, 40)
    assert max(map(len, lines)) <= 40
    assert {"cluster_2_5", "movements", "NBL"} <= set(" ".join(lines).split())
    lines = lines_of(table, 20)  # here even words have to be divided
    assert max(map(len, lines)) <= 20
    whole = "".join("".join(lines).split())
    assert "SBL" in whole and "45" in whole
    assert len(lines_of(table)) < len(lines_of(table, 40))


def test_a_long_name_is_broken_and_leaves_numbers_their_place() -> None:
    table = named_table("Words", "policy")
    table.add_column("s", justify="right")
    table.add_row("p" * 30, "151.2")
    _, first, second = [line.split() for line in lines_of(table) if "p" in line]
    assert first == ["p" * 22, "151.2"] and second == ["p" * 8]


def test_a_light_has_the_names_of_sumo_and_of_its_agent() -> None:
    names = LightNames.of(Network.read(load_scenario("grid2x2-v1")))
    assert [*map(names.text, names.agents)] == [
        "A1 (signal_0)", "A2 (signal_1)", "B1 (signal_2)", "B2 (signal_3)",
    ]  # fmt: skip
    assert names.text("A1_B1_0") == "A1_B1_0"
    named = LightNames({"9": "a_0", "b": "b"}, {"9": "Long Road / Cross Street"})
    assert named.whole("9") == "Long Road / Cross Street, 9 (a_0)"
    assert named.text("b") == named.whole("b") == "b"


@pytest.fixture(scope="module")
def plans() -> list[SignalPlan]:
    return [*read_plans(TODAY)]


def test_plans_and_approaches_fit_without_divided_words(plans: list[SignalPlan]) -> None:
    names = LightNames({"cluster_2_5": "signalb_0", "9": "signala_0"})
    lines = lines_of(plan_table(plans, names))
    assert max(map(len, lines)) <= 80
    words = set(" ".join(lines).split())
    assert {"cluster_2_5", "(signalb_0)", "9", "(signala_0)", "turns", "all-red"} <= words
    network = Network.read(load_scenario("grid2x2-v1"))
    delays = {rule: {"A1_B1": (300.0, 60.0)} for rule in ("programme", "max-pressure-loss")}
    words = set(" ".join(lines_of(control_delay_table("Delay", delays, network))).split())
    assert {"B1", "(signal_2)", "eastbound", "max-pressure-loss"} <= words
    rules = ("programme", "webster", "actuated:40", "max-pressure:20")
    lines = lines_of(
        control_delay_table("Delay", dict.fromkeys(rules, delays["programme"]), network)
    )
    assert max(map(len, lines)) <= 80
    heads = " ".join(rules).replace(":", ": ").split()  # a name breaks at its colon
    assert {"(signal_2)", "eastbound", *heads} <= set(" ".join(lines).split())
    assert sum("A1_B1" in line for line in lines) == 2  # three rules side by side, one beneath


def test_an_approach_that_nobody_passes_is_the_worst_and_hides_no_other() -> None:
    network = Network.read(load_scenario("grid2x2-v1"))
    starved = {"A1_A2": (100.0, 20.0), "A1_B1": (0.0, math.inf), "B1_A1": (50.0, 90.0)}
    rows = lines_of(control_delay_table("Delay", {"mine": starved}, network))
    found = [line.split() for line in rows if "A1" in line and "_" in line]
    assert [next(word for word in row if "_" in word and "(" not in word) for row in found] == [
        "A1_B1", "B1_A1", "A1_A2",
    ]  # fmt: skip
    assert "none passed" in " ".join(found[0])


def test_vehicles_that_pass_are_those_of_all_controllers() -> None:
    network = Network.read(load_scenario("grid2x2-v1"))
    delays = {"a": {"A1_A2": (19.0, 20.0)}, "b": {"A1_A2": (24.4, 20.0)}, "c": {}}
    (row,) = (
        line for line in lines_of(control_delay_table("Delay", delays, network)) if "A1_A2" in line
    )
    assert "19-24" in row.split()


def test_an_approach_to_which_nobody_comes_is_not_the_worst() -> None:
    network = Network.read(load_scenario("grid2x2-v1"))
    quiet = {"A1_B1": (0.0, math.nan), "A1_A2": (100.0, 20.0)}
    rows = [
        line
        for line in lines_of(control_delay_table("Delay", {"a": quiet}, network))
        if "A1_" in line
    ]
    assert "A1_A2" in rows[0] and "none came" in rows[1]
