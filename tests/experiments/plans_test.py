"""The plan of a run: what it says, and how much work it expects."""

from __future__ import annotations

import contextlib
import math
import shlex
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader
from tensorboard.util import tensor_util

from tests.runs import SMALL, play_nothing
from ugat_marl.__main__ import main
from ugat_marl.data import Run
from ugat_marl.experiments import LearnerSpec, transfer
from ugat_marl.experiments.driver import OTHER_PARTS
from ugat_marl.experiments.jobs import JobRecord
from ugat_marl.experiments.plans import described_plan, jobs_beside, work_of
from ugat_marl.experiments.transfers import TRAININGS, planned_jobs
from ugat_marl.grounding import StreetConfig, UgatConfig
from ugat_marl.parallel import LocalProcesses
from ugat_marl.policies import DQN_NAME, UNIVERSAL_NAME, DQNConfig
from ugat_marl.progress import Share, Silent


class Mine:
    """A learner of a user's own."""


def test_the_work_of_a_run_is_counted_by_hand(tmp_path: Path) -> None:
    config = replace(SMALL, control=True, evaluation_seeds=3, tuning_seeds=2)
    work = work_of(planned_jobs(config), tmp_path, 100.0)
    # direct, UGAT, the control and two rules, in two domains, with three seeds
    assert work["evaluating"].units == 5 * 2 * 3
    assert work["plain sim"].units == 2 and work["grounded"].units == 2 * 2
    assert work["training"].units == 2 * 2, "without the two that it shares with direct transfer"
    assert work["best rule"].units == 2 * (14 + 7)
    assert (work["roll-outs"].units, work["roll-outs"].weight) == (4, 2 * 2.0)
    assert work["fitting"].units == 3 * 2 * 2


def test_a_continued_training_counts_without_what_it_continues(tmp_path: Path) -> None:
    config = replace(SMALL, fine_tuned=True, ugat=replace(SMALL.ugat, pretrain_episodes=20))
    plan = planned_jobs(config)
    assert work_of(plan, tmp_path, 100.0)["training"].units == 2 * 2
    lines = described_plan(plan, tmp_path, tmp_path, 100.0)
    assert any("fine-tuned on the same data: 4 episodes;" in line for line in lines)


def test_a_fitted_street_simulates_shorter_worlds(tmp_path: Path) -> None:
    ugat = UgatConfig(iterations=2, street=StreetConfig(simulations=50, further=10, judged=3))
    config = replace(SMALL, ugat=ugat)
    work = work_of(planned_jobs(config), tmp_path, 7200.0)
    assert (work["fitting"].units, work["fitting"].weight) == (60, 0.25 * 1.5)
    assert work["comparing"].units == (2 + 3) * 3 * 2
    assert work["under delays"].units == 2 * 6 * 2
    assert work["late greens"].units == 3 * 2 * ugat.grounded_episodes


def test_lessons_are_work(tmp_path: Path) -> None:
    def lessons(budget: int, learner: str, rival: Any = "none") -> int:
        ugat = UgatConfig(iterations=2, street=StreetConfig(rule_budget=budget, rival=rival))
        config = replace(SMALL, ugat=ugat, learner=learner, dqn=DQNConfig())
        return work_of(planned_jobs(config), tmp_path, 7200.0)["lessons"].units

    # 14 rules once, 3 of them twice more, 3 episodes shown: in the simulation and per iteration
    assert lessons(0, UNIVERSAL_NAME) == 3 * (14 + 3 * 2 + 3)
    # where rules race in the fitted street anyway, only the shown ones
    assert lessons(4, UNIVERSAL_NAME) == (14 + 3 * 2 + 3) + 2 * 3
    # the rival looks for the rule that is best with late greens
    assert lessons(4, UNIVERSAL_NAME, "matched") == lessons(4, UNIVERSAL_NAME) + 2 * 23
    assert lessons(4, UNIVERSAL_NAME, "several") == lessons(4, UNIVERSAL_NAME) + 3 * 2 * 23
    assert lessons(0, DQN_NAME) == 0


def test_the_control_has_lessons_too(tmp_path: Path) -> None:
    config = replace(SMALL, control=True, learner=UNIVERSAL_NAME, dqn=DQNConfig())
    with_control = work_of(planned_jobs(config), tmp_path, 100.0)["lessons"].units
    without = work_of(planned_jobs(replace(config, control=False)), tmp_path, 100.0)
    assert with_control == without["lessons"].units + 14 + 3 * 2 + 3
    tuned = work_of(planned_jobs(replace(config, fine_tuned=True)), tmp_path, 100.0)
    assert tuned["lessons"].units == with_control, "none in the real domain"


def test_parts_are_done_beside_the_first_where_that_is_worth_it(tmp_path: Path) -> None:
    config = replace(SMALL, control=True, evaluation_seeds=18)
    plan = planned_jobs(config)
    beside = jobs_beside(plan, tmp_path, 100.0, 2)
    assert beside == plan[1:] and len(beside) == 3
    assert jobs_beside(plan, tmp_path, 100.0, 1) == [], "one core"
    assert jobs_beside(planned_jobs(replace(SMALL, evaluation_seeds=1)), tmp_path, 100.0, 2) == []
    longer = [plan[0], *(replace(job, rule_budget=10_000) for job in plan[1:])]
    assert jobs_beside(longer, tmp_path, 100.0, 2) == [], "on one core it would be the longest"
    with LocalProcesses(2) as elsewhere:
        assert jobs_beside(plan, tmp_path, 100.0, elsewhere) == []
    mine = LearnerSpec(f"{__name__}:Mine")
    own = [replace(job, setting=replace(job.setting, learner=mine)) for job in plan]
    assert jobs_beside(own, tmp_path, 100.0, 2) == []

    alone = work_of(plan, tmp_path, 100.0)
    work = work_of(plan, tmp_path, 100.0, beside)
    assert "training" in alone and "training" not in work
    assert work[OTHER_PARTS].units == 3

    def total(shares: Mapping[str, Share]) -> float:
        return sum(share.units * share.weight for share in shares.values())

    assert total(work) == pytest.approx(total(alone))
    lines = described_plan(plan, tmp_path, tmp_path, 100.0, beside)
    assert [line.endswith(", meanwhile") for line in lines[1:5]] == [False, True, True, True]


@pytest.mark.parametrize(
    ("learner", "budget", "races"),
    [(UNIVERSAL_NAME, None, True), (DQN_NAME, None, False), (DQN_NAME, 2, True),
     (UNIVERSAL_NAME, 0, False)],
)  # fmt: skip
def test_rules_race_in_the_fitted_street_where_rules_teach(
    tmp_path: Path, learner: str, budget: int | None, races: bool
) -> None:
    ugat = UgatConfig(iterations=1, street=StreetConfig(rule_budget=budget))
    config = replace(SMALL, ugat=ugat, learner=learner, dqn=DQNConfig())
    assert ("rules" in work_of(planned_jobs(config), tmp_path, 7200.0)) == races


def test_what_is_done_is_neither_planned_nor_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    play_nothing(monkeypatch)
    transfer(SMALL, tmp_path)
    plan = planned_jobs(replace(SMALL, oracle=True))
    work = work_of(plan, tmp_path / TRAININGS, 100.0)
    assert set(work) == {"evaluating", "training"}
    lines = described_plan(plan, tmp_path, tmp_path / TRAININGS, 100.0)
    assert lines[0] == f"run: {tmp_path}"
    assert "done before: 3 of 4" in lines[1]
    assert not any("of other settings" in line for line in lines)
    (left,) = [
        job for job in plan if not JobRecord.read(tmp_path / TRAININGS / job.name).is_whole(job)
    ]
    former = f"{left.name.rpartition('-')[0]}-0123456789"
    (tmp_path / TRAININGS / former).mkdir()
    lines = described_plan(plan, tmp_path, tmp_path / TRAININGS, 100.0)
    assert lines[2].startswith(f"note: 1 training ('{former}') here is of other settings")
    assert [line for line in lines if "trained in real: 6 episodes" in line]


def test_tensorboard_has_the_curves_that_matter(
    tmp_path: Path,
) -> None:
    class Verbose(Silent):
        verbose = True

    numbers = {
        "att_s/V4": 1.0, "forward/error": 2.0, "forward/error/A1": 3.0, "other": 4.0,
        "channel/lag_2": 0.5, "effects/headway": 1.4, "effects/headway/low": 1.3,
    }  # fmt: skip
    for reporter, expected in ((Silent(), 4), (Verbose(), 7)):
        run = Run(tmp_path / str(expected), {}, reporter)
        run.log("iteration", 1, numbers)
        run.close()
        assert len(points(tmp_path / str(expected))) == expected
        assert len(run.metrics.rows) == 7


def test_curves_are_read_by_tensorboard(tmp_path: Path) -> None:
    with contextlib.closing(Run(tmp_path, {}, Silent())) as run:
        for step, value in enumerate((1.5, math.nan, 2.5)):
            run.log("iteration", step, {"forward/error": value, "gate/alpha": 10.0 * step})
    assert points(tmp_path) == [
        ("iteration/forward/error", 0, 1.5), ("iteration/gate/alpha", 0, 0.0),
        ("iteration/gate/alpha", 1, 10.0),
        ("iteration/forward/error", 2, 2.5), ("iteration/gate/alpha", 2, 20.0),
    ]  # fmt: skip


def points(run: Path) -> list[tuple[str, int, float]]:
    """All points of a run's curves, as TensorBoard's own reader finds them."""
    (file,) = (run / "tensorboard").iterdir()
    return [
        (value.tag, event.step, tensor_util.make_ndarray(value.tensor).item())
        for event in EventFileLoader(str(file)).Load()
        for value in event.summary.value
    ]


def test_an_interrupted_training_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("ugat_marl.cli.train.transfer", interrupted)
    words = ["train", "single-v1", "--real", "startup_delay=1+headway=2", "--iterations", "1"]
    monkeypatch.setattr(sys, "argv", ["/bin/ugat-marl", *words])
    assert main(words) == 130
    folder = "runs/single-v1-startup_delay=1+headway=2-s0"
    err = capsys.readouterr().err
    assert f"run: {folder}" in err
    assert err.endswith(f"go on with: ugat-marl {' '.join(words)} --out {folder} --resume\n")
    words += ["--out", str(tmp_path / "my run"), "--resume"]
    monkeypatch.setattr(sys, "argv", ["/bin/ugat-marl", *words])
    assert main(words) == 130
    err = capsys.readouterr().err
    assert err.count("--out") == 1 and err.count("--resume") == 1
    assert f"'{tmp_path}/my run'" in err


@pytest.mark.parametrize(
    ("words", "module"),
    [
        (["paper", "gap", "--seeds", "2"], "paper"),
        (["compare", "single-v1", "--name", "my own", "--learner", "ippo"], "compare"),
    ],
)
def test_interrupted_trainings_of_a_table_say_how_to_go_on(
    words: list[str],
    module: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(f"ugat_marl.cli.{module}.compare", interrupted)
    monkeypatch.chdir(tmp_path)
    runs = f"runs/{module}"
    for argv, call in (
        (["/bin/ugat-marl", *words, "--quiet"], shlex.join(words)),
        (["/bin/other"], shlex.join(words[:2]) + " ..."),
    ):
        monkeypatch.setattr(sys, "argv", argv)
        assert main(words) == 130
        err = capsys.readouterr().err
        assert err.endswith(f"trainings: {runs}; go on with: ugat-marl {call}\n")
