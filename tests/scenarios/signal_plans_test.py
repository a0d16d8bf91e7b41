"""Fixed-time plans: rings and barriers by hand, what SUMO shows, tables, Synchro's files."""

from __future__ import annotations

import contextlib
import copy
import math
import shlex
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import libsumo
import pytest

from ugat_marl.__main__ import main
from ugat_marl.effects import load_scenario
from ugat_marl.envs import parallel_env
from ugat_marl.errors import OptionError, ScenarioError
from ugat_marl.experiments import rule_factory, typical_plans
from ugat_marl.experiments.typical_plans import _divided, _shortest_cycle_s
from ugat_marl.files import Document
from ugat_marl.progress import Silent
from ugat_marl.scenarios import (
    Intersection,
    Network,
    PlanPhase,
    Scenario,
    SignalPlan,
    copy_papers,
    movement_codes,
    offset_notes,
    programme_notes,
    programme_plan,
    read_plans,
    read_scenario,
    read_utdf,
    with_plans,
    write_plans,
    yellow_notes,
)
from ugat_marl.scenarios.importers.utdf import _matched
from ugat_marl.scenarios.signal_plans import phase_times

LEFTS_FIRST = (  # two rings, two barriers: lefts before through, of unequal length
    (1, 1, "EBL", 15), (1, 1, "WBT WBR", 35), (1, 2, "NBL", 15), (1, 2, "SBT SBR", 25),
    (2, 1, "WBL", 20), (2, 1, "EBT EBR", 30), (2, 2, "SBL", 15), (2, 2, "NBT NBR", 25),
)  # fmt: skip


def dual_ring(offset_s: float = 0.0) -> SignalPlan:
    phases = tuple(
        PlanPhase(ring, barrier, tuple(codes.split()), split, 3, 2)
        for ring, barrier, codes, split in LEFTS_FIRST
    )
    return SignalPlan("A1", 90, offset_s, phases)


@pytest.fixture(scope="module")
def single() -> Scenario:
    return load_scenario("single-v1").with_duration(300)


def changed_programmes(scenario: Scenario, change: Callable[[ET.Element], object]) -> Scenario:
    def of_part(part: ET.Element) -> None:
        for logic in part.iter("tlLogic"):
            change(logic)

    return replace(scenario, network=scenario.network.changed(of_part))


def green_at(scenario: Scenario, second: float, letters: str = "Gg") -> set[str]:
    """Movements with these letters at a second of the cycle of the light's programme."""
    network = Network.read(scenario)
    (light,) = network.intersections
    left = second % sum(seconds for seconds, _ in light.programme)
    for seconds, state in light.programme:
        if left < seconds:
            codes = movement_codes(light, network)
            return {code for link, code in codes.items() if state[link.index] in letters}
        left -= seconds
    raise AssertionError


def test_rings_run_side_by_side_and_meet_at_the_barrier(single: Scenario) -> None:
    planned = with_plans(single, [dual_ring()], "plans.csv")
    (light,) = Network.read(planned).intersections
    assert sum(seconds for seconds, _ in light.programme) == 90
    assert green_at(planned, 5) == {"EBL", "WBL"}
    assert green_at(planned, 11, "y") == {"EBL"}  # 15 s: 10 green, 3 yellow, 2 red
    assert green_at(planned, 14) == {"WBL"}
    assert green_at(planned, 25) == {"WBT", "WBR", "EBT", "EBR"}
    assert green_at(planned, 46, "y") == {"WBT", "WBR", "EBT", "EBR"}
    assert green_at(planned, 49) == set()  # both rings wait for the barrier
    assert green_at(planned, 51) == {"NBL", "SBL"}
    assert green_at(planned, 70) == {"SBT", "SBR", "NBT", "NBR"}
    assert all("g" not in state for _, state in light.programme)  # nobody gives way


def test_a_ring_that_sits_a_barrier_out_clears_before_it(single: Scenario) -> None:
    """Else its green would end at the instant at which the cross street's begins."""
    phases = (
        PlanPhase(1, 1, ("EBT", "EBR", "EBL"), 45, 3, 2),
        PlanPhase(2, 1, ("WBT", "WBR", "WBL"), 45, 3, 2),
        PlanPhase(1, 2, ("NBT", "NBR", "NBL", "SBT", "SBR", "SBL"), 45, 3, 2),
    )
    scenario = with_plans(single, [SignalPlan("A1", 90, 0, phases)], "plans.csv")
    assert {"WBT", "EBT"} <= green_at(scenario, 39)
    assert {"WBT", "EBT"} <= green_at(scenario, 41, "y")
    assert not green_at(scenario, 44, "Ggy")
    assert {"NBT", "SBT"} <= green_at(scenario, 46)
    assert {"NBT", "SBT"} <= green_at(scenario, 86, "y")


def test_movements_that_share_a_letter_are_green_together(single: Scenario) -> None:
    """The left turn from the east has the letter of a through lane, to which the other yields."""
    (light,) = Network.read(single).intersections
    index = {(link.from_edge, link.to_edge): link.index for link in light.links}
    through, opposite = index["east1_A1", "A1_west1"], index["west1_A1", "A1_northA"]

    def share(part: ET.Element) -> None:
        for way in part.iter("connection"):
            if (way.get("from"), way.get("to")) == ("east1_A1", "A1_southA"):
                way.set("linkIndex", str(through))

    shared = replace(single, network=single.network.changed(share))
    (light,) = Network.read(with_plans(shared, [dual_ring()], "plan.csv")).intersections
    states = [state for _, state in light.programme]
    both = [state for state in states if state[opposite] in "Gg" and state[through] in "Gg"]
    assert both and all(state[opposite] == "g" for state in both)


@pytest.mark.parametrize("split_s", [14.99, 15.0, 15.01])
def test_a_plan_lasts_its_cycle(single: Scenario, split_s: float) -> None:
    codes = ("WBL EBL", "WBT WBR EBT EBR", "NBL SBL", "NBT NBR SBT SBR")
    phases = tuple(PlanPhase(1, 1, tuple(each.split()), split_s, 3, 2) for each in codes)
    (light,) = Network.read(
        with_plans(single, [SignalPlan("A1", 60, 0.0, phases)], "plan.csv")
    ).intersections
    assert sum(seconds for seconds, _ in light.programme) == pytest.approx(60.0, abs=1e-9)


def test_a_movement_of_two_phases_in_turn_stays_green(single: Scenario) -> None:
    phases = (
        PlanPhase(1, 1, ("EBL", "EBT", "EBR"), 25, 3, 2),
        PlanPhase(1, 1, ("EBT", "EBR", "WBT", "WBR"), 25, 3, 2),
        PlanPhase(1, 1, ("WBL", "WBR", "NBR"), 15, 3, 2),
        PlanPhase(1, 1, ("NBT", "NBR", "SBT", "SBR", "NBL", "SBL"), 25, 3, 2),
    )
    planned = with_plans(single, [SignalPlan("A1", 90, 0, phases)], "plans.csv")
    assert green_at(planned, 21) == {"EBT", "EBR"}
    assert green_at(planned, 21, "y") == {"EBL"}
    assert green_at(planned, 24) == {"EBT", "EBR"}
    assert green_at(planned, 70, "g") == {"NBL", "SBL"}  # with the traffic opposite
    assert green_at(planned, 70, "G") == {"NBT", "NBR", "SBT", "SBR"}
    assert green_at(planned, 86, "y") == {"NBT", "NBL", "SBT", "SBL", "SBR", "NBR"}


IN_TURN = ((1, 1, "EBL WBL EBR", 25), (1, 1, "EBT EBR WBT WBR", 25), (1, 1, "NBL SBL EBR", 25))
LAST = "NBT NBR SBT SBR EBR"
AT_A_BARRIER = (
    (1, 1, "EBL WBL", 15), (1, 1, "EBT WBT WBR", 35), (2, 1, "EBR", 49.96),
    (1, 2, "NBL SBL", 15), (1, 2, "NBT SBT SBR", 25), (2, 2, "EBR NBR", 40),
)  # fmt: skip


@pytest.mark.parametrize(
    "listed",
    [(*IN_TURN, (1, 1, LAST, split_s)) for split_s in (15.0, 14.96, 15.04)] + [AT_A_BARRIER],
)
def test_a_movement_of_all_phases_is_always_green(
    listed: tuple[tuple[int, int, str, float], ...], single: Scenario
) -> None:
    """Also where the splits differ from the cycle, or between rings, by what rounding leaves."""
    phases = tuple(PlanPhase(a, b, tuple(each.split()), s, 3, 2) for a, b, each, s in listed)
    scenario = with_plans(single, [SignalPlan("A1", 90, 0, phases)], "plans.csv")
    network = Network.read(scenario)
    (light,) = network.intersections
    (index,) = (
        link.index for link, code in movement_codes(light, network).items() if code == "EBR"
    )
    assert {state[index] for _, state in light.programme} <= set("Gg")
    assert sum(seconds for seconds, _ in light.programme) == pytest.approx(90, abs=1e-9)


@pytest.mark.parametrize(("begin_s", "offset_s"), [(0, 0), (0, 25), (100, 40)])
def test_sumo_shows_the_plan_at_its_offset(
    single: Scenario, begin_s: float, offset_s: float
) -> None:
    settings = single.settings.model_copy(update={"begin_s": begin_s})
    scenario = with_plans(replace(single, settings=settings), [dual_ring(offset_s)], "plans.csv")
    network = Network.read(scenario)
    (light,) = network.intersections
    env = parallel_env(scenario, signals="programme")
    env.reset(seed=1)
    for _ in range(12):
        env.step(dict.fromkeys(env.agents, 0))
        time_s = env.snapshot.time_s
        assert env._simulator is not None
        state = env._simulator.signals()["A1"]
        shown = {
            c for link, c in movement_codes(light, network).items() if state[link.index] in "Gg"
        }
        # SUMO shows a state from the second after its start on.
        assert shown in (green_at(scenario, time_s - offset_s - d) for d in (0.0, 1.0))
    env.close()


def test_a_table_comes_back(single: Scenario, tmp_path: Path) -> None:
    network = Network.read(single)
    (light,) = network.intersections
    plans = (dual_ring(12.5),)
    write_plans(tmp_path / "p.csv", plans, network)
    assert read_plans(tmp_path / "p.csv") == plans
    text = (tmp_path / "p.csv").read_text(encoding="utf-8-sig").replace(",", ";")
    (tmp_path / "q.csv").write_text(text)
    assert read_plans(tmp_path / "q.csv") == plans
    (tmp_path / "q.csv").write_text(text.replace("12.5", "12,5"))
    assert read_plans(tmp_path / "q.csv") == plans
    own = programme_plan(light, network)
    assert own.cycle_s == sum(seconds for seconds, _ in light.programme)
    again = with_plans(single, [own], "plans.csv")
    assert Network.read(again).intersections[0].programme == light.programme


@pytest.mark.parametrize(
    ("offset", "additional", "expected_s"),
    [
        ("37", "", 37),
        ("0:01:40", "", 10),
        ("-10", "", 80),
        ("begin", "", 30),
        ("37", '<tlLogic id="A1" programID="0" offset="12"/>', 12),
        ("37", '<tlLogic id="A1" programID="other" offset="12"/>', 37),
    ],
)
def test_the_offset_of_a_programme_comes_back(
    single: Scenario, offset: str, additional: str, expected_s: float, tmp_path: Path
) -> None:
    more = Document("o.add.xml", None, f"<additional>{additional}</additional>".encode())
    changed = replace(
        changed_programmes(single, lambda logic: logic.set("offset", offset)),
        additional=(more,),
        settings=single.settings.model_copy(update={"begin_s": 120.0}),
    )
    network = Network.read(changed)
    write_plans(tmp_path / "p.csv", [programme_plan(network.intersections[0], network)], network)
    (plan,) = read_plans(tmp_path / "p.csv")
    assert (plan.cycle_s, plan.offset_s) == (90, expected_s)
    (light,) = Network.read(with_plans(changed, [plan], "p.csv")).intersections
    assert light.offset_s == expected_s


def test_a_plan_that_differs_from_its_programme_is_noted() -> None:
    """In the programmes of Q, T and V some right turns are yellow between two of their greens."""
    mixed = load_scenario("mixed-v1")
    network = Network.read(mixed)
    plans = [programme_plan(light, network) for light in network.intersections]
    (note,) = programme_notes(mixed, plans, "p.csv")
    assert "than the programme at Q (EBR), T (WBR), V (WBR): in a plan" in note
    short = replace(plans[0], phases=plans[0].phases[1:])
    (note,) = programme_notes(mixed, [short], "p.csv")
    assert note.startswith("--apply would refuse this plan, so change it first: p.csv: light 'P'")


@pytest.mark.parametrize("later_s", [0.0, 37.0])
def test_a_plan_that_is_its_programme_needs_no_note(later_s: float) -> None:
    grid = load_scenario("grid2x2-v1")

    def later(logic: ET.Element) -> None:
        logic.set("offset", str(later_s))
        first = logic[0]  # the cycle then begins with the yellow after this green
        logic.remove(first)
        logic.append(first)

    moved = changed_programmes(grid, later)
    network = Network.read(moved)
    plans = [programme_plan(light, network) for light in network.intersections]
    assert all(plan.offset_s != later_s for plan in plans)
    assert programme_notes(moved, plans, "p.csv") == []


@pytest.mark.parametrize(
    ("kind", "said"), [("actuated", "follows the traffic (actuated)"), ("NEMA", "rings of its own")]
)
def test_a_programme_with_other_times_than_its_file_is_noted(kind: str, said: str) -> None:
    varying = changed_programmes(load_scenario("single-v1"), lambda logic: logic.set("type", kind))
    network = Network.read(varying)
    plans = [programme_plan(light, network) for light in network.intersections]
    (note,) = programme_notes(varying, plans, "p.csv")
    assert said in note and "SUMO shows other times" in note


def test_red_amber_is_no_yellow() -> None:
    """As in Austria, Germany and the United Kingdom: 2 s of it before each green."""

    def change(logic: Any) -> None:
        for phase in list(logic):
            if "G" in phase.get("state") and "y" not in phase.get("state"):
                amber = copy.deepcopy(phase)
                amber.set("duration", "2")
                amber.set("state", phase.get("state").replace("G", "u").replace("g", "u"))
                logic.insert(list(logic).index(phase), amber)

    plain = load_scenario("single-v1")
    amber = changed_programmes(plain, change)
    (light,), (changed,) = Network.read(plain).intersections, Network.read(amber).intersections
    before = programme_plan(light, Network.read(plain))
    after = programme_plan(changed, Network.read(amber))
    assert [phase.yellow_s for phase in after.phases] == [x.yellow_s for x in before.phases]
    assert [
        p.all_red_s - q.all_red_s for p, q in zip(after.phases, before.phases, strict=True)
    ] == [2.0] * len(before.phases)


HEAD = "light,cycle_s,offset_s,ring,barrier,movements,split_s,yellow_s,all_red_s\n"
GOOD = "A1,60,0,1,1,NBT NBR SBT SBR NBL SBL,30,3,2\nA1,60,0,1,1,EBT EBR WBT WBR EBL WBL,30,3,2\n"


def test_blank_rows_of_a_spreadsheet_are_left_out(tmp_path: Path) -> None:
    plain, blank = tmp_path / "plain.csv", tmp_path / "blank.csv"
    plain.write_text(HEAD + GOOD)
    blank.write_text(HEAD + GOOD + ",,,,,,,,\n , ,,,,,,,\n")
    assert read_plans(blank) == read_plans(plain)


def test_columns_may_have_capitals(tmp_path: Path) -> None:
    plain, large = tmp_path / "plain.csv", tmp_path / "large.csv"
    plain.write_text(HEAD + GOOD)
    large.write_text(HEAD.title() + GOOD)
    assert read_plans(large) == read_plans(plain)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("light,cycle\nA1,60\n", "line 1: the column cycle_s is missing; is it 'cycle'?"),
        (HEAD, "no row holds a phase"),
        (HEAD + GOOD.replace("A1,60,0,1,1,E", "A1,70,0,1,1,E"), "line 3: light 'A1' has another"),
        (HEAD + GOOD.replace("A1,60", "A1,70"), "its splits make 60 s and its cycle_s is 70"),
        (HEAD + GOOD + GOOD.replace(",30,3,2", ",20,3,2", 1).replace(",30,3,2", ",40,3,2", 1),
         "make them equal; NBT NBR SBT SBR NBL SBL is there twice: a light has one plan"),
        (HEAD + GOOD.replace(",30,3,2\nA1", ",5,3,2\nA1"), "phase 1 (NBT NBR"),
        (HEAD + GOOD.replace(",30,3,2", ",many,3,2", 1), "line 2: split_s = 'many' is not a time"),
        (HEAD + GOOD.replace("60,0,1,1", "60,0,x,1", 1), "line 2: ring = 'x' is not a number"),
        (HEAD + GOOD.replace("NBT NBR SBT SBR NBL SBL", ""), "line 2: movements is blank"),
        (HEAD + GOOD.replace("A1,60,0,1,1,E", ",60,0,1,1,E"), "line 3: light is blank; write it"),
        (HEAD + GOOD.replace("NBT NBR", "NBT NXR"), "it has no movement 'NXR'; it has EBL"),
        (HEAD + GOOD.replace("NBL SBL", ""), "no phase serves NBL SBL, and"),
        (HEAD + GOOD.replace("NBL SBL", "NBL SBL WBT"), "are green together and cross"),
        (HEAD + GOOD.replace("NBL SBL", "NBL SBL EBL"), "EBL are green together and cross"),
        (HEAD + (GOOD + "A1,60,0,1,1,NBL WBT,30,3,2\n").replace("A1,60", "A1,90"),
         "WBT and NBL are green together and cross or merge"),
        (HEAD + GOOD.replace("A1", "B7"), "light 'B7' is not an agent of scenario"),
        (HEAD + GOOD.replace("A1,60,0,1,1,EBT", "A1,60,0,2,1,EBT").replace("WBL,30", "WBL,20"),
         "the rings differ before the end of barrier 1 (ring 1 30 s, ring 2 20 s)"),
    ],
)  # fmt: skip
def test_plans_that_are_wrong(
    text: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "t.csv").write_text(text)
    words = ["plan", "single-v1", "--apply", str(tmp_path / "t.csv"), "--out", str(tmp_path / "x")]
    assert main(words) == 2
    err = capsys.readouterr().err
    assert says in err
    assert len(err.strip().splitlines()) == 1
    assert not (tmp_path / "x").exists()


def test_a_table_that_was_changed_is_not_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["plan", "grid2x2-v1", "--out", str(tmp_path / "plans.csv")]
    assert main(words) == 0
    changed = (tmp_path / "plans.csv").read_text(encoding="utf-8-sig").splitlines()
    lights = {line.split(",")[0] for line in changed[1:]}
    one = next(iter(sorted(lights)))
    kept = [changed[0], *(line for line in changed[1:] if line.startswith(one))]
    (tmp_path / "plans.csv").write_text("\n".join(kept) + "\n")
    assert main(words) == 2
    assert "perhaps with changes of yours" in capsys.readouterr().err
    put = ["plan", "grid2x2-v1", "--apply", str(tmp_path / "plans.csv"), "--out"]
    assert main([*put, str(tmp_path / "town")]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "3 lights (" in shown and "without a plan; own programme kept" in shown
    assert main([*words, "--force"]) == 0


@pytest.mark.parametrize(("name", "is_it"), [("rings", "ring"), ("bar", "barrier")])
def test_a_mistyped_column_is_named(
    name: str, is_it: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert is_it in HEAD.strip().split(",")
    (tmp_path / "t.csv").write_text(HEAD.replace(is_it, name) + GOOD)
    words = ["plan", "single-v1", "--apply", str(tmp_path / "t.csv"), "--out", str(tmp_path / "x")]
    assert main(words) == 2
    assert f"line 1: column {name!r} is not known; is it {is_it!r}?" in capsys.readouterr().err


def test_a_scenario_with_plans_keeps_its_papers(tmp_path: Path) -> None:
    new = ["scenario", "new", str(tmp_path / "g"), "--grid", "1x1", "--vph", "200"]
    assert main([*new, "--duration-s", "100"]) == 0
    (tmp_path / "g" / "counts-fit.csv").write_text("counted\n")
    before = (tmp_path / "g" / "README.md").read_text()
    table, out = str(tmp_path / "p.csv"), str(tmp_path / "h")
    assert main(["plan", str(tmp_path / "g"), "--out", table]) == 0
    put = ["plan", str(tmp_path / "g"), "--apply", table, "--out"]
    assert main([*put, out]) == 0 == main([*put, out, "--force"])
    assert main([*put, str(tmp_path / "g"), "--force"]) == 0
    for folder in ("g", "h"):
        text = (tmp_path / folder / "README.md").read_text()
        assert text.startswith(f"# {folder}\n\nIts lights have the programmes of `p.csv`")
        assert before.partition("\n")[2] in text
        words = ["ugat-marl", "plan", str(tmp_path / "g"), "--out", str(tmp_path / folder)]
        commands = [shlex.split(line) for line in text.splitlines() if line.startswith("ugat-marl")]
        assert [command[1] for command in commands] == ["scenario", "plan"]
        assert commands[-1] == [*words, "--apply", table, *["--force"] * (folder == "g")]
        assert (tmp_path / folder / "counts-fit.csv").read_text() == "counted\n"


def test_a_readme_without_a_title_is_kept_whole(tmp_path: Path) -> None:
    (tmp_path / "from").mkdir()
    (tmp_path / "to").mkdir()
    (tmp_path / "from" / "README.md").write_text("Counts by the city, CC-BY.\n\nMore.\n")
    copy_papers(tmp_path / "from", tmp_path / "to", "new", "Changed.", "ugat-marl plan x")
    text = (tmp_path / "to" / "README.md").read_text()
    assert text == (
        "# new\n\nChanged.\n\nCounts by the city, CC-BY.\n\nMore.\n\n"
        "## Changed with\n\n```sh\nugat-marl plan x\n```\n"
    )


def test_a_short_yellow_is_noted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "t.csv").write_text(HEAD + GOOD.replace("30,3,2", "30,0,2", 1))
    words = ["plan", "single-v1", "--apply", str(tmp_path / "t.csv"), "--out", str(tmp_path / "x")]
    assert main(words) == 0
    note = "note: yellow is short at A1 (phase 1: 0 s); 3 to 6 s are usual"
    assert note in capsys.readouterr().out
    assert main(["plan", str(tmp_path / "x"), "--out", str(tmp_path / "again.csv")]) == 0
    assert note in capsys.readouterr().out
    stays = PlanPhase(1, 1, ("NBT", "SBT"), 30.0, 0.0, 0.0)
    more = PlanPhase(1, 1, ("NBT", "SBT", "NBL"), 30.0, 3.0, 2.0)
    assert not yellow_notes([SignalPlan("A1", 60.0, 0.0, (stays, more))])  # none of them ends
    rounded = replace(stays, split_s=29.96)
    assert not yellow_notes([SignalPlan("A1", 60.0, 0.0, (more, rounded))])
    assert yellow_notes([SignalPlan("A1", 60.0, 0.0, (replace(more, yellow_s=1.0), stays))])


def test_an_offset_beyond_the_cycle_is_noted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "t.csv").write_text(HEAD + GOOD.replace("A1,60,0", "A1,60,130"))
    words = ["plan", "single-v1", "--apply", str(tmp_path / "t.csv"), "--out", str(tmp_path / "x")]
    assert main(words) == 0
    told = "note: whole cycles of the offset count nothing, at A1 (130 s of a cycle of 60 s: 10 s)"
    assert told in capsys.readouterr().out
    assert offset_notes([dual_ring(90.0)]) and not offset_notes([dual_ring(89.5)])


UTDF = """[Network]
Network Settings
RECORDNAME,DATA
Metric,1
[Nodes]
Node Data
INTID,TYPE,X,Y,Z,DESCRIPTION
7,0,0,0,0,"Main & First, town"
[Lanes]
Lane Group Data
RECORDNAME,INTID,NBL,NBT,NBR,SBL,SBT,SBR,EBL,EBT,EBR,WBL,WBT,WBR,PED
Lanes,7,1,2,0,1,2,0,1,2,0,1,2,0,
Phase1,7,3,{nbt},,7,4,,5,2,,1,6,,
PermPhase1,7,,,,,,,2,,,,,,
[Timeplans]
Timing Plan Settings
RECORDNAME,INTID,DATA
Control Type,7,0
Cycle Length,7,90.0
Referenced To,7,{referenced}
Reference Phase,7,{reference}
Offset,7,{offset}
[Phases]
Phasing Data
RECORDNAME,INTID,D1,D2,D3,D4,D5,D6,D7,D8
BRP,7,111,112,211,212,121,122,221,222
MinGreen,7,4,4,4,4,4,4,4,4
MaxGreen,7,{d1},30,10,20,10,30,10,20
Yellow,7,3,3,3,3,3,3.5,3,3
AllRed,7,{allred},2,2,2,2,1.5,2,2
"""


def synchro(folder: Path, **values: object) -> Path:
    """A file as Synchro writes it: barrier 1 is 50 s, barrier 2 40 s."""
    given: dict[str, object] = {
        "referenced": 3, "reference": 206, "offset": 30, "d1": 10, "nbt": 8, "allred": 2,
    }  # fmt: skip
    text = UTDF.format(**(given | values))
    (folder / "synchro.csv").write_text(text)
    return folder / "synchro.csv"


def test_synchro_s_rings_and_barriers(single: Scenario, tmp_path: Path) -> None:
    """Phases 1, 2 | 3, 4 in one ring and 5, 6 | 7, 8 in the other; BRP is barrier, ring, place."""
    network = Network.read(single)
    (plan,), notes = read_utdf(synchro(tmp_path), network, {})
    assert notes == ()
    assert (plan.light, plan.cycle_s) == ("A1", 90)
    assert [(p.ring, p.barrier, p.split_s) for p in plan.phases] == [
        (1, 1, 15), (1, 1, 35), (2, 1, 15), (2, 1, 35),
        (1, 2, 15), (1, 2, 25), (2, 2, 15), (2, 2, 25),
    ]  # fmt: skip
    served = [set(p.movements) for p in plan.phases]
    assert served[0] == {"WBL"}  # phase 1
    assert served[1] == {"EBT", "EBR", "EBL"}  # phase 2, right turns with it, left permitted
    assert served[2] == {"EBL"} and served[3] == {"WBT", "WBR"}  # phases 5 and 6
    assert (plan.phases[3].yellow_s, plan.phases[3].all_red_s) == (3.5, 1.5)
    # Phases 2 and 6 turn green 15 s after the start of the cycle, which is what offset 30 is for.
    assert plan.offset_s == 15
    planned = with_plans(single, [plan], "synchro.csv")
    assert green_at(planned, 25, "g") == {"EBL"}
    assert green_at(planned, 5, "G") == {"WBL", "EBL"}


@pytest.mark.parametrize("case", [str, str.upper, str.lower])
def test_synchro_s_file_from_a_spreadsheet(
    case: Callable[[str], str], single: Scenario, tmp_path: Path
) -> None:
    """A spreadsheet may save it with semicolons and decimal commas, and people retype headings."""
    network = Network.read(single)
    wanted = read_utdf(synchro(tmp_path), network, {})
    text = (tmp_path / "synchro.csv").read_text()
    (tmp_path / "s.csv").write_text(case(text.replace(",", ";").replace(".", ",")))
    assert read_utdf(tmp_path / "s.csv", network, {}) == wanted


EMPTY = ",,,,,,,,"
"""Phases 9 to 16 of a light that has eight."""
SEDONA: dict[str, dict[str, str]] = {
    "eight phases, the left turns unlike": {
        "Phase1": "3,8,,7,4,,1,6,,5,2,",
        "PermPhase1": "8,,8,4,,,6,,6,2,2,2",
        "Cycle Length": "120.0",
        "Offset": "58.1",
        "BRP": "111,112,211,212,121,122,221,222,311,312,411,412,321,322,421,422",
        "MaxGreen": "6.5,47.6,6.5,40,18.5,35.6,6.5,40" + EMPTY,
        "Yellow": "3,3.9,3,3.2,3,3.9,3,3.2" + EMPTY,
        "AllRed": "1,1.4,1,2.9,1,1.4,1,2.9" + EMPTY,
        "Start": "0,10.5,63.4,73.9,0,22.5,63.4,73.9" + EMPTY,
    },
    "side streets one after the other": {
        "Phase1": ",4,,,3,,1,6,,5,2,",
        "PermPhase1": "4,,4,3,,3,6,,6,2,,2",
        "Cycle Length": "140.0",
        "Offset": "46.0",
        "BRP": "111,112,211,212,121,122,,,311,312,411,412,321,322,421,422",
        "MaxGreen": "11,41,34,33.3,11,41,," + EMPTY,
        "Yellow": "3,3.6,3.3,3,3,3.6,," + EMPTY,
        "AllRed": "1,1.4,2.7,2.7,1,1.4,," + EMPTY,
        "Start": "130,5,51,91,130,5,," + EMPTY,
    },
    "rings that yield at different times": {
        "Phase1": ",4,,,4,,1,6,,5,2,",
        "PermPhase1": "4,,,4,,,6,,,2,,2",
        "Cycle Length": "120.0",
        "Offset": "61.0",
        "BRP": "111,112,211,212,121,122,221,222,311,312,411,412,321,322,421,422",
        "MaxGreen": "21.5,37,,47,21.5,35.5,," + EMPTY,
        "Yellow": "3,3.7,,3,3,3.7,," + EMPTY,
        "AllRed": "1,1.2,,2.6,1,2.7,," + EMPTY,
        "Start": "0,25.5,,67.4,0,25.5,," + EMPTY,
    },
    "an offset to the later green": {
        "Phase1": "7,4,,3,8,,1,6,,5,2,",  # not in the source: the usual numbers
        "PermPhase1": ",,4,,,8,,,6,,,2",
        "Cycle Length": "120.0",
        "Offset": "70.0",
        "Referenced To": "0",
        "Reference Phase": "408",
        "BRP": "111,112,211,212,121,122,221,222" + EMPTY,
        "MaxGreen": "11,40.8,13,37.1,15,36.8,8,42.1" + EMPTY,
        "Yellow": "3,3.6,3,3.6,3,3.6,3,3.6" + EMPTY,
        "AllRed": "1,1.6,1,1.3,1,1.6,1,1.3" + EMPTY,
        "Start": "112,7,53,70,112,11,53,65" + EMPTY,
    },
}
"""Timings as Synchro wrote them: three lights of State Route 89A in Sedona, Arizona (2023), and one
of McDowell Road in Phoenix (2018).
"""


@pytest.mark.parametrize("name", SEDONA)
def test_phases_begin_when_synchro_says(name: str, single: Scenario, tmp_path: Path) -> None:
    """``Start`` is Synchro's own begin of every phase, which the reader does not use."""
    light = SEDONA[name]
    head = "RECORDNAME,INTID"
    lines = [
        "[Lanes]", "Lane Group Data",
        f"{head},NBL,NBT,NBR,SBL,SBT,SBR,EBL,EBT,EBR,WBL,WBT,WBR,NWL,NWR,PED,HOLD",
        *(f"{record},31,{light[record]},,,," for record in ("Phase1", "PermPhase1")),
        "SignControl,6,,,,0,,,0,,,,,,0,,,", "",
        "[Timeplans]", "Timing Plan Settings", f"{head},DATA", "Control Type,31,3",
        *(f"{record},31,{light[record]}" for record in ("Cycle Length", "Offset")),
        f"Referenced To,31,{light.get('Referenced To', '1')}",
        f"Reference Phase,31,{light.get('Reference Phase', '206')}", "Node 0,31,31", "",
        "[Phases]", "Phasing Data", f"{head},{','.join(f'D{n}' for n in range(1, 17))}",
        *(f"{record},31,{light[record]}" for record in ("BRP", "MaxGreen", "Yellow", "AllRed")),
        f"Start,31,{light['Start']}", "", "",
    ]  # fmt: skip
    (tmp_path / "sedona.csv").write_text("\r\n".join(lines))
    (plan,), _ = read_utdf(tmp_path / "sedona.csv", Network.read(single), {"31": "A1"})
    begins = [(plan.offset_s + begin) % plan.cycle_s for begin, *_ in phase_times(plan)]
    places = zip(light["BRP"].split(","), light["Start"].split(","), strict=True)
    said = sorted((place, float(start)) for place, start in places if start)
    assert begins == pytest.approx([start for _, start in said])
    assert [f"{p.barrier}{p.ring}" for p in plan.phases] == [place[:2] for place, _ in said]


@pytest.mark.parametrize(
    ("referenced", "offset", "begins"),
    [(0, 15, 0), (3, 0, 75), (1, 45, 0), (2, 48, 0), (1, 0, 45)],
)  # phases 2 and 6 are green from 15 to 45, and red from 48 or 48.5
def test_offsets_refer_to_parts_of_phases(
    referenced: int, offset: float, begins: float, single: Scenario, tmp_path: Path
) -> None:
    file = synchro(tmp_path, referenced=referenced, offset=offset)
    (plan,), _ = read_utdf(file, Network.read(single), {"7": "A1"})
    assert plan.offset_s == begins


@pytest.mark.parametrize(
    ("values", "lights", "says"),
    [
        ({"d1": 12}, (), "the rings differ before the end of barrier 1 (ring 1 52 s, ring 2 50 s)"),
        ({"d1": "ten"}, (), "maxgreen = 'ten' is not a number"),
        ({"referenced": 4}, (), "Referenced To = 4: offsets are read that refer to"),
        ({"reference": 9}, (), "Reference Phase = 9: the plan has no such phase"),
        ({"reference": 2.7}, (), "Reference Phase = 2.7 is not a whole number"),
        ({"allred": -3, "d1": 15}, (), "allred = '-3' is not a time of 0 to 3600 s"),
        ({}, ("8=A1",), "has no plan for an intersection '8'; it has 7"),
        ({}, ("7=B1",), "'B1' is not an agent of the scenario; its agents are A1"),
        ({}, ("7",), "--lights 7: give INTID=LIGHT"),
    ],
)
def test_files_of_synchro_that_are_wrong(
    values: dict[str, object],
    lights: tuple[str, ...],
    says: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = synchro(tmp_path, **values)
    words = ["plan", "single-v1", "--apply", str(file), "--out", str(tmp_path / "x")]
    assert main([*words, *(["--lights", *lights] if lights else [])]) == 2
    assert says in capsys.readouterr().err


@pytest.mark.parametrize(
    ("brp", "says"),
    [("11,112,211,212", "BRP 11 of phase 1"), ("111,112,201,212", "BRP 201 of phase 3"),
     ("-111,112,211,212", "BRP -111 of phase 1")],
)  # fmt: skip
def test_places_of_phases_have_three_digits(
    brp: str, says: str, single: Scenario, tmp_path: Path
) -> None:
    file = synchro(tmp_path)
    file.write_text(file.read_text().replace("111,112,211,212", brp))
    with pytest.raises(ScenarioError, match=f"{says} is not barrier, ring and position"):
        read_utdf(file, Network.read(single), {})


def test_a_column_with_another_kind_of_digit_is_no_phase(single: Scenario, tmp_path: Path) -> None:
    file = synchro(tmp_path)
    before, _ = read_utdf(file, Network.read(single), {})
    text = file.read_text().replace(",D8\n", ",D8,D²\n").replace("221,222\n", "221,222,311\n")
    file.write_text(text, encoding="utf-8")
    assert read_utdf(file, Network.read(single), {})[0] == before


def test_two_plans_of_one_intersection_are_refused(single: Scenario, tmp_path: Path) -> None:
    file = synchro(tmp_path)
    other = synchro(tmp_path, d1=12).read_text()
    again = synchro(tmp_path)
    again.write_text(again.read_text() + other)
    with pytest.raises(ScenarioError, match=r"a file holds one plan for an intersection"):
        read_utdf(again, Network.read(single), {"7": "A1"})
    file = synchro(tmp_path)
    file.write_text(2 * file.read_text())  # the same plan twice does no harm
    read_utdf(file, Network.read(single), {"7": "A1"})


def test_a_movement_that_goes_with_another_turn_is_noted(single: Scenario, tmp_path: Path) -> None:
    _, notes = read_utdf(synchro(tmp_path, nbt=""), Network.read(single), {})
    assert notes == (
        "light 'A1': NBT has no phase in the file; it goes with another turn of its approach, in "
        "phase 3",
    )


def test_a_plan_becomes_a_scenario(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["plan", "single-v1", "--apply", str(synchro(tmp_path)), "--out", str(tmp_path / "p")]
    assert main(words) == 0
    assert "single-v1 with programmes from 1 plan\n" in capsys.readouterr().out
    (light,) = Network.read(read_scenario(tmp_path / "p")).intersections
    assert sum(seconds for seconds, _ in light.programme) == 90
    assert len(light.phases) == 8  # agents keep their phases
    assert main(words) == 2
    assert "--force replaces it" in capsys.readouterr().err


def test_two_lights_need_a_word_on_which_is_which(tmp_path: Path) -> None:
    network = Network.read(load_scenario("grid2x2-v1"))
    with pytest.raises(ScenarioError, match=r"which intersection is which light\? Give --lights"):
        read_utdf(synchro(tmp_path), network, {})


@pytest.mark.parametrize(
    ("lights", "matched"),
    [
        ({}, {"A": "A", "B": "B"}),
        ({"5": "C"}, {"A": "A", "B": "B", "5": "C"}),
        ({"5": "B"}, {"A": "A", "5": "B"}),
        ({"B": "C"}, {"A": "A", "B": "C"}),
    ],
)
def test_ids_that_are_the_same_need_no_word(
    lights: dict[str, str], matched: dict[str, str]
) -> None:
    nodes: dict[str, Any] = dict.fromkeys("AB5")
    known: dict[str, Any] = dict.fromkeys("ABC")
    assert _matched(nodes, known, lights, Path("plan.csv")) == matched


def test_a_later_plan_of_another_light_keeps_the_earlier_one() -> None:
    grid = load_scenario("grid2x2-v1")
    lights = Network.read(grid).intersections[:2]
    longer: list[SignalPlan] = []
    for light in lights:
        plan = programme_plan(light, Network.read(grid))
        first = replace(plan.phases[0], split_s=plan.phases[0].split_s + 10)
        longer.append(replace(plan, cycle_s=plan.cycle_s + 10, phases=(first, *plan.phases[1:])))
    both = with_plans(with_plans(grid, longer[:1], "a.csv"), longer[1:], "b.csv")
    shown = {light.id: light.programme for light in Network.read(both).intersections}
    for plan in longer:
        assert sum(seconds for seconds, _ in shown[plan.light]) == plan.cycle_s


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("A1,60,0,NBT,30,3,1,5", "line 2: '5' is beyond the last column; put cells that hold"),
        ("x" * 200_000, "line 2: not CSV"),
    ],
)
def test_cells_beyond_the_columns_are_refused(text: str, told: str, tmp_path: Path) -> None:
    path = tmp_path / "plans.csv"
    path.write_text(f"light,cycle_s,offset_s,movements,split_s,yellow_s,all_red_s\n{text}\n")
    with pytest.raises(ScenarioError, match=told):
        read_plans(path)


def test_a_column_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "plans.csv"
    path.write_text("light,cycle_s,offset_s,movements,split_s,yellow_s,all_red_s,split_s\n")
    with pytest.raises(ScenarioError, match="the column split_s is there twice"):
        read_plans(path)
    path.write_text("x" * 200_000)
    with pytest.raises(ScenarioError, match="line 1: not CSV"):
        read_plans(path)


def test_the_typical_plan_of_a_fixed_time_is_itself(single: Scenario) -> None:
    """Four phases of 30 s: needs of 25/120 each, so C = 20 / (1 - 100/120) = 120 s."""
    (plan,) = typical_plans(
        single.with_duration(1200), rule_factory("fixed-time:30"), "sim", (1,), Silent()
    )
    assert (plan.cycle_s, [phase.split_s for phase in plan.phases]) == (120, [30] * 4)
    assert {code for phase in plan.phases for code in phase.movements} == {
        f"{way}{turn}" for way in ("NB", "EB", "SB", "WB") for turn in "LTR"
    }
    # A phase is asked for every 30 s, and its green follows the clearance of 5 s.
    assert plan.offset_s % 30 == 5


def test_the_typical_plan_of_the_programme_is_the_programme(single: Scenario) -> None:
    network = Network.read(single)
    (plan,) = typical_plans(single, rule_factory("programme"), "sim", (1,), Silent())
    assert plan == programme_plan(network.intersections[0], network)


def test_a_plan_from_the_queue_model_would_have_no_yellow(single: Scenario) -> None:
    with pytest.raises(OptionError, match="no yellow; leave out queue_model"):
        typical_plans(single, rule_factory("fixed-time:30"), "meso", (1,), Silent())
    with pytest.raises(OptionError, match="at least one seed"):
        typical_plans(single, rule_factory("fixed-time:30"), "sim", (), Silent())
    (plan,) = typical_plans(single, rule_factory("programme"), "meso", (1,), Silent())
    assert [phase.yellow_s for phase in plan.phases] == [3.0] * len(plan.phases)


def test_the_busiest_phase_gets_what_it_needs() -> None:
    """Equal phases hide who pays for the least greens."""
    needs = {0: 0.5, 1: 0.1, 2: 0.1, 3: 0.1}
    cycle_s = _shortest_cycle_s(needs, 5.0, 10)
    assert cycle_s == pytest.approx(100.0)  # 4 x 5 / (1 - 0.8)
    wanted = {phase: 5.0 + need * 100 for phase, need in needs.items()}
    assert _divided(100, 10, wanted) == {0: 55, 1: 15, 2: 15, 3: 15}
    # A phase of a short need lasts as long as it must, and the others need a longer cycle for it:
    # with 20 s for the last one C = (10 + 20) / (1 - 0.7) = 100 s.
    cycle_s = _shortest_cycle_s({0: 0.5, 1: 0.2, 2: 0.01}, 5.0, 20)
    assert cycle_s == pytest.approx(100.0)
    assert _shortest_cycle_s({0: 0.6, 1: 0.4}, 5.0, 10) == math.inf
    assert _divided(30, 10, {0: 5.0, 1: 5.0}) == {0: 15, 1: 15}


def timetable(single: Scenario) -> tuple[Scenario, Intersection]:
    """The light runs "day" for a minute, then "night"; "late" is defined last and never runs."""
    (light,) = Network.read(single).intersections

    def logic(name: str, green_s: int) -> str:
        phases = "".join(
            f'<phase duration="{green_s}" state="{state}"/>'
            f'<phase duration="3" state="{state.replace("G", "y")}"/>'
            for state in light.phases[:2]
        )
        return f'<tlLogic id="A1" type="static" programID="{name}" offset="0">{phases}</tlLogic>'

    text = (
        f"<additional>{logic('day', 30)}{logic('night', 20)}{logic('late', 10)}"
        '<WAUT id="w" refTime="0" startProg="day"><wautSwitch time="60" to="night"/></WAUT>'
        '<wautJunction wautID="w" junctionID="A1"/></additional>'
    )
    document = Document("waut.add.xml", None, text.encode())
    return replace(single, additional=(document,)), light


def test_a_timetable_begins_with_its_first_programme(single: Scenario) -> None:
    (light,) = Network.read(timetable(single)[0]).intersections
    assert [seconds for seconds, _ in light.programme] == [30, 3, 30, 3]
    assert light.times_vary == "a timetable (WAUT) switches it"


def test_a_plan_is_not_switched_off_by_a_timetable(single: Scenario) -> None:
    planned = with_plans(timetable(single)[0], [dual_ring()], "plans.csv")
    (light,) = Network.read(planned).intersections
    assert sum(seconds for seconds, _ in light.programme) == 90 and not light.times_vary
    with contextlib.closing(
        parallel_env(planned, signals="programme", simulator="inprocess")
    ) as env:
        env.reset(seed=1)
        for _ in range(12):
            env.step({"signal_0": 0})
        assert libsumo.trafficlight.getProgram("A1") == "plan"


@pytest.mark.parametrize("place", ["network", "signals.add.xml", "plans.add.xml"])
def test_a_plan_beside_another_of_its_name_is_run(place: str, single: Scenario) -> None:
    """SUMO refuses two programmes of one light with the same id."""
    if place == "network":
        scenario = changed_programmes(single, lambda logic: logic.set("programID", "plan"))
    else:
        scenario = with_plans(single, [dual_ring(5.0)], "plans.csv")
        (before,) = scenario.additional
        scenario = replace(scenario, additional=(replace(before, name=place),))
    planned = with_plans(scenario, [dual_ring()], "plans.csv")
    (light,) = Network.read(planned).intersections
    assert (sum(seconds for seconds, _ in light.programme), light.offset_s) == (90, 0)
    with contextlib.closing(
        parallel_env(planned, signals="programme", simulator="inprocess")
    ) as env:
        env.reset(seed=1)
        program = "plan" if place == "plans.add.xml" else "plan-2"
        assert libsumo.trafficlight.getProgram("A1") == program


def test_two_plans_of_one_light_are_refused(single: Scenario) -> None:
    with pytest.raises(ScenarioError, match="two plans for light 'A1'"):
        with_plans(single, [dual_ring(), dual_ring(5.0)], "plans.csv")


def test_no_part_of_a_cycle_is_shorter_than_its_last_decimal(single: Scenario) -> None:
    """SUMO refuses a phase of 0 s."""
    phases = (
        PlanPhase(1, 1, ("EBT", "EBR", "EBL"), 30, 3, 2),
        PlanPhase(2, 1, ("WBT", "WBR", "WBL"), 30.0004, 3, 2),
        PlanPhase(1, 2, ("NBT", "NBR", "SBT", "SBR", "NBL", "SBL"), 30, 3, 2),
    )
    scenario = with_plans(single, [SignalPlan("A1", 60, 0, phases)], "plans.csv")
    (light,) = Network.read(scenario).intersections
    assert min(seconds for seconds, _ in light.programme) >= 0.001
