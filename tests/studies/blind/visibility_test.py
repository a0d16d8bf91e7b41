"""The test that is told what is hidden: closed forms, and effects made again from their labels."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from studies.blind import visibility
from studies.blind.cases import Case, Hidden, Label, write_label, write_plan
from studies.blind.grade import SEEN, grade_cases
from studies.blind.table import rows_of
from studies.blind.visibility import effect_of, judge_visibility, separation
from tests.studies.blind.diagnoses import says
from ugat_marl.diagnosis import Reference, Tally
from ugat_marl.diagnosis.features import BIN_FEATURES, EVENT_FEATURES, FEATURES
from ugat_marl.diagnosis.statistics import Pools
from ugat_marl.diagnosis.thresholds import Thresholds
from ugat_marl.effects import effect_from_record
from ugat_marl.errors import UnknownNameError

THRESHOLDS = Thresholds()

Array = NDArray[np.float64]

NETWORK = Pools({"network": np.ones((1, 1))}, THRESHOLDS)
ROWS = [row for row, (name, _, _) in enumerate(FEATURES) if name not in EVENT_FEATURES]
PERIODS = 3


def days_of(values: Array) -> list[Tally]:
    """Days whose features have these means, ``(days, features)``, over 50 observations."""
    found: list[Tally] = []
    for day in values:
        sums = np.zeros((len(FEATURES), 1, 2))
        sums[ROWS, 0] = np.stack([day * 50.0, np.full_like(day, 50.0)], axis=-1)
        found.append(Tally(sums, np.zeros((len(BIN_FEATURES), 1, 1))))
    return found


def gaussian(seed: Sequence[int], days: int) -> Array:
    return 10.0 + np.random.default_rng(seed).standard_normal((days, len(ROWS)))


@pytest.fixture(scope="module")
def reference() -> Reference:
    """Many days of unit variance, and no correlation at all."""
    made = Reference(NETWORK, days_of(gaussian([1], 4000)))
    made.blocks["network"] = replace(made.blocks["network"], correlation=np.eye(len(FEATURES)))
    return made


@pytest.mark.parametrize("deviations", [1.0, 4.0])
def test_a_shift_is_seen_as_far_as_it_lies_in_noise(
    reference: Reference, deviations: float
) -> None:
    before = gaussian([2], 24)
    data = days_of(gaussian([3], PERIODS))
    move = np.zeros(len(ROWS))
    move[:4] = deviations / 2 / np.sqrt(PERIODS)  # four statistics, each with noise 1 / sqrt(3)
    found = separation(reference, data, days_of(before + move), days_of(before))
    assert found == pytest.approx(deviations, rel=0.05)


def test_chance_alone_is_not_seen(reference: Reference) -> None:
    """Days with other vehicles differ everywhere; both halves would have to differ alike."""
    data = days_of(gaussian([3], PERIODS))
    found = [
        separation(reference, data, days_of(gaussian([4, i], 24)), days_of(gaussian([5, i], 24)))
        for i in range(20)
    ]
    squares = np.square(found)
    # Were the halves not crossed, the square would be that of all statistics: about 12.
    assert squares.mean() < 3.0
    assert np.mean(np.array(found) >= SEEN) <= 0.05


@pytest.mark.parametrize(("moved", "seen"), [(slice(8), 0.0), (slice(8, 24), 4.0)])
def test_days_that_choose_the_block_do_not_measure_it(
    reference: Reference, moved: slice, seen: float
) -> None:
    before = gaussian([2], 24)
    after = before.copy()
    after[moved, :4] += 2 / np.sqrt(PERIODS)
    data = days_of(gaussian([3], PERIODS))
    assert separation(reference, data, days_of(after), days_of(before)) == pytest.approx(
        seen, rel=0.05
    )


@pytest.mark.parametrize(
    "record",
    [
        {"name": "headway", "seconds": 1.4},
        {"name": "late_green", "place": "*", "seconds": 2.0},
        {"name": "turning", "from_edge": "a", "to_edge": "b", "share": 0.2},
        {"name": "lane_closure", "lane": "a_0", "begin_s": 600.0, "end_s": 900.0},
    ],
)
def test_a_label_says_all_about_an_effect(record: dict[str, object]) -> None:
    effect = effect_from_record(record)
    assert effect_of(Hidden.of(effect)) == effect


def hide(directory: Path, **effects: str) -> None:
    """A blind test in which these names are hidden, and none was found."""
    write_plan(directory, tuple(Case(case, "single-v1") for case in effects))
    for case, name in effects.items():
        shown = Hidden.of(effect_from_record({"name": name, "seconds": 3.5}))
        write_label(
            directory,
            Label(
                case=case, scenario="single-v1", group="single", hidden=name, strength="large",
                effects=(shown,), leave_out=(), lights=("C",), begin_s=0.0, end_s=3600.0,
                periods=5, speeds=True, policy="fixed-time:30", seed=1, measured="",
            ),
        )  # fmt: skip
        (directory / case).mkdir()
        diagnosis = says("no_discrepancy")
        assert diagnosis is not None
        diagnosis.write(directory / case)


def test_what_the_log_shows_is_visible_and_the_table_says_so(tmp_path: Path) -> None:
    hide(tmp_path, case001="yellow_time", case002="headway", case003="headway")
    assert judge_visibility(tmp_path, only=["case001"]) == {"case001": None}
    known = {"case001": None, "case002": SEEN - 0.1}
    (tmp_path / visibility.VISIBLE).write_text(json.dumps({"seed": 0, "cases": known}))
    grades = grade_cases(tmp_path)
    assert [item.visible for item in grades] == [True, False, None]
    row = next(x for x in rows_of(grades) if "knows the effect" in x.measure)
    assert (row.n, row.count) == (1, 0), "only the first is known to be visible, and was missed"
    assert asdict(grades[0])["visible"] is True


def test_another_seed_judges_every_case_anew(tmp_path: Path) -> None:
    hide(tmp_path, case001="yellow_time")
    of_seed_0 = {"seed": 0, "cases": {"case001": 7.0}}
    (tmp_path / visibility.VISIBLE).write_text(json.dumps(of_seed_0))
    assert judge_visibility(tmp_path, seed=0) == {"case001": 7.0}
    assert judge_visibility(tmp_path, seed=1) == {"case001": None}


def test_a_case_that_is_not_there(tmp_path: Path) -> None:
    hide(tmp_path, case001="headway")
    with pytest.raises(UnknownNameError, match="case009"):
        judge_visibility(tmp_path, only=["case009"])
