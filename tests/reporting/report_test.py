"""Tables and pictures of evaluations."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import pytest
from rich.console import Console, RenderableType

from ugat_marl.data import Metrics, Scores
from ugat_marl.effects import load_scenario
from ugat_marl.experiments import (
    DIRECT,
    GROUNDED_NAME,
    ORACLE,
    RULE,
    Evaluation,
    matched_name,
    variant_name,
)
from ugat_marl.experiments.evaluation import Result
from ugat_marl.reporting import (
    calibration_picture,
    charts,
    measures_table,
    service_tables,
    training_page,
    transfer_picture,
    transfer_table,
)
from ugat_marl.reporting.formats import mean_text
from ugat_marl.reporting.service_tables import service_grid
from ugat_marl.scenarios import Network

BASE = Scores(0.0, 90.0, 500.0, -3.0, 3.0, 0.4, 50.0, 520.0, 515.0, 0.0)
ATT = {
    "direct transfer": ((100.0, 102.0, 101.0), (150.0, 151.0, 900.0)),
    "phase (the paper's UGAT)": ((99.0, 100.0, 98.0), (130.0, 131.0, 132.0)),
    "rule largest-queue:40": ((120.0, 121.0, 119.0), (125.0, 126.0, 124.0)),
}


@pytest.fixture
def found() -> Evaluation:
    results = tuple(
        Result(policy, domain, seed, replace(BASE, att_s=att, backlog=7.0 * (att > 800)))
        for policy, domains in ATT.items()
        for domain, values in zip(("sim", "V4"), domains, strict=True)
        for seed, att in enumerate(values)
    )
    return Evaluation("grid2x2-v1", "0", results, {"best rule in V4": "largest-queue:40"})


def printed(table: RenderableType) -> str:
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(table)
    return console.export_text()


def test_the_transfer_table_says_it_all_in_80_columns(found: Evaluation) -> None:
    text = printed(transfer_table(found))
    assert max(map(len, text.splitlines())) <= 80
    row = next(line for line in text.splitlines() if "phase (the paper" in line)
    for cell in ("99.0", "131", "+32.0", "6.0"):
        assert cell in row
    assert "best rule in V4: largest-queue:40" in text
    assert "medians in V4: direct transfer 151" in " ".join(text.split())
    assert "medians in sim" not in text


def test_names_and_numbers_are_whole_in_narrow_columns(found: Evaluation) -> None:
    """Two real domains leave the names of policies 14 characters."""
    shown = [
        replace(
            r,
            policy=r.policy.replace("largest-queue:40", "fixed-time:30"),
            domain=domain,
            scores=replace(r.scores, att_s=min(r.scores.att_s, 152.0)),
        )
        for r in found.results
        for domain in ((r.domain, "V3") if r.domain == "V4" else (r.domain,))
    ]
    narrow = Evaluation("s", "0", tuple(shown), {})
    text = printed(transfer_table(narrow))
    assert max(map(len, text.splitlines())) <= 80
    words = text.partition("3 seeds")[0].split()
    for policy in narrow.policies:
        assert set(policy.split()) <= set(words)
        for domain in narrow.domains:
            numbers = mean_text(narrow.estimate(policy, domain, "att_s")).split()
            assert len(numbers) == 2 and set(numbers) <= set(words)


def test_six_policies_have_room(found: Evaluation) -> None:
    """The table says where the corrected policy was trained."""
    more = ("more plain sim", "corrected sim", "rule max-pressure:20")
    results = [*found.results]
    for policy in more:
        results += [
            replace(r, policy=policy)
            for r in found.results
            if r.policy == "phase (the paper's UGAT)"
        ]
    six = Evaluation(
        found.scenario, "0", tuple(results), {"corrected sim": "runs/v4-diagnosis/corrected"}
    )
    text = printed(transfer_table(six))
    assert max(map(len, text.splitlines())) <= 80
    assert "corrected sim: trained in runs/v4-diagnosis/corrected" in " ".join(text.split())


def test_the_measures_table_tells_who_was_kept_out(found: Evaluation) -> None:
    text = printed(measures_table(found))
    assert max(map(len, text.splitlines())) <= 80
    assert "never entered: direct transfer 2.3" in text
    assert "gap to sim" in text
    assert text.count("its 95 % interval") == 3  # of the gaps
    assert text.count("95 % interval") == 6 + 3


def test_the_picture_is_a_picture(found: Evaluation, tmp_path: Path) -> None:
    metrics = Metrics(
        [("iteration", i, f"att_s/{d}", 100.0) for i in (0, 1) for d in ("sim", "V4")]
    )
    path = tmp_path / "deep" / "gap.png"
    transfer_picture(found, metrics, path)
    pixels = matplotlib.image.imread(path)
    assert pixels.shape[:2] == (540, 1920)
    assert pixels.std() > 0.05


def test_the_calibration_is_drawn_if_there_was_an_iteration(tmp_path: Path) -> None:
    numbers = {f"calibration/risk_by_coverage/{i}": 0.05 * i for i in range(5)}
    numbers |= {
        f"calibration/{name}": 0.6 for name in ("auroc", "ece", "mean_u", "mean_u_off_data")
    }
    metrics, path = Metrics(), tmp_path / "calibration.png"
    assert not calibration_picture(metrics, path) and not path.exists()
    for iteration in (1, 2, 3):
        metrics.add("iteration", iteration, numbers)
        assert calibration_picture(metrics, path)
        assert matplotlib.image.imread(path).std() > 0.05


def test_levels_of_service_of_policies_and_approaches(found: Evaluation) -> None:
    """Two approaches: 100 vehicles lose 20 s in every episode, 300 lose 60 s or, in V4, 100 s."""
    network = Network.read(load_scenario("grid2x2-v1"))
    results = tuple(
        replace(
            result,
            scores=replace(
                result.scores,
                approaches={
                    "A1_A2": (100.0, 20.0),
                    "A1_B1": (300.0, 60.0 if result.domain == "sim" else 100.0),
                },
            ),
        )
        for result in found.results
    )  # fmt: skip
    (tables,) = service_tables(replace(found, results=results), network)
    text = " ".join(printed(tables).split())
    assert "direct transfer 50.0 D 80.0 E worst approach 60.0 E 100 F" in text
    assert "The same by approach, in V4" in text
    rows = [line.split() for line in printed(tables).splitlines() if "A1_" in line]
    assert [row[2:4] for row in rows] == [["A1_B1", "300"], ["A1_A2", "100"]]  # the worst first
    assert [row[0] for row in rows] == ["B1", "A2"]
    assert [row[1] for row in rows] == ["eastbound", "northbound"]
    assert "(signal_" in printed(tables)  # the agent stands below the light
    assert service_tables(found, network) == []  # nothing was measured
    many = tuple(replace(r, domain=f"d{k}") for k in range(20) for r in results[:1])
    (tables,) = service_tables(replace(found, results=many), network)
    text = printed(tables)
    assert all(f" d{k}" in text for k in range(20)) and text.count("50.0 D") == 20
    grid = service_grid(replace(found, results=results), ["phase (the paper's UGAT)"], network)
    assert grid is not None
    assert grid.rows[0] == ["B1 (signal_2)", "eastbound", "A1_B1", "100 F"]
    assert service_grid(found, ["phase (the paper's UGAT)"], None) is None


def test_the_radar_of_a_table_has_every_grounding() -> None:
    labels = [DIRECT, *GROUNDED_NAME.values(), "more plain sim", ORACLE, RULE]
    lines = training_page._radar_lines(labels, {(label, "V4"): {} for label in labels}, "V4")
    assert [*lines] == [
        "direct transfer in the simulation",
        "direct transfer in V4",
        "phase (the paper's UGAT) in V4",
        "timed in V4",
        "fitted street in V4",
        "trained in real in V4",
        "best rule, tuned there in V4",
    ]


def test_variants_push_nothing_off_the_radar() -> None:
    variants = [variant_name("timed", f"α = {k}") for k in range(9)]
    labels = [DIRECT, GROUNDED_NAME["timed"], *variants, GROUNDED_NAME["street"], ORACLE, RULE]
    lines = training_page._radar_lines(labels, {(label, "V4"): {} for label in labels}, "V4")
    kept = (DIRECT, GROUNDED_NAME["timed"], GROUNDED_NAME["street"], ORACLE, RULE)
    assert [*lines][1:] == [f"{label} in V4" for label in kept]


def test_a_radar_shows_a_grounding_whose_alpha_does_not_follow_u() -> None:
    fixed, ungated = variant_name("phase", "α = 0.3"), variant_name("timed", "no gate")
    labels = [DIRECT, fixed, ungated, matched_name("timed")]
    lines = training_page._radar_lines(labels, {(label, "V4"): {} for label in labels}, "V4")
    assert [*lines][1:] == [f"{label} in V4" for label in (DIRECT, fixed, ungated)]
    variants = [variant_name("phase", f"α = {k}") for k in range(9)]
    labels_of_alpha = [DIRECT, *variants, *GROUNDED_NAME.values(), RULE]
    cells = {(label, "V4"): {} for label in labels_of_alpha}
    alone = training_page._radar_lines(labels_of_alpha, cells, "V4")
    assert [*alone][1:] == [f"{x} in V4" for x in (DIRECT, *GROUNDED_NAME.values(), RULE)]
    assert charts.row_of("phase", labels) == fixed
    assert charts.row_of("timed", labels) == ungated
    assert charts.row_of("timed", ["timed: no gate", "timed"]) == "timed"


def test_settings_of_fewer_trainings_are_named() -> None:
    """Their means are over other seeds than those beside them."""
    rows = [
        {"setting": "direct transfer", "domain": "V4", "training_seeds": 2},
        {"setting": "trained in real", "domain": "V4", "training_seeds": 1},
    ]
    assert training_page._fewer_seeds(rows) == " Of fewer than 2 trainings: trained in real (1)."
    assert training_page._fewer_seeds(rows[:1]) == ""
