"""Algorithm 1 on a real scenario: what is stored, what is resumed, what is refused."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest
import torch

from tests.interrupts import KillAfter, KillAt
from tests.runs import SMALL, checkpoint_of, play_nothing, search_few_rules, weights
from ugat_marl.__main__ import main
from ugat_marl.data import Metrics, Run, TransitionLog, lock_folder
from ugat_marl.effects import load_scenario, scenario_in_domain
from ugat_marl.envs import parallel_env
from ugat_marl.errors import CheckpointError, LogError, OptionError, ScenarioError, UnknownNameError
from ugat_marl.experiments import TransferConfig, transfer
from ugat_marl.grounding import FitConfig, GateConfig, SimulatedWorld, UgatConfig
from ugat_marl.grounding.ugat import Ugat
from ugat_marl.grounding.uncertainty import MethodName
from ugat_marl.policies import (
    DQN,
    EpsilonGreedy,
    make_rule,
    observer_of,
    roll_out,
)
from ugat_marl.progress import Silent

FEW_RULES = ("largest-queue:20", "programme")
LONG = replace(SMALL, ugat=replace(SMALL.ugat, pretrain_episodes=12))
"""Plain training is saved after ten episodes, so that it can be interrupted in between."""


@pytest.fixture(autouse=True)
def few_rules(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search for the best rule is not under test here."""
    search_few_rules(monkeypatch, *FEW_RULES)


@pytest.fixture
def unjudged(monkeypatch: pytest.MonkeyPatch) -> None:
    play_nothing(monkeypatch)


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run nobody disturbs."""
    folder = tmp_path_factory.mktemp("unbroken") / "run"
    with pytest.MonkeyPatch.context() as patch:
        search_few_rules(patch, *FEW_RULES)
        transfer(LONG, folder)
    return folder


def test_a_run_leaves_what_it_promises(unbroken: Path) -> None:
    table = json.loads((unbroken / "table.json").read_text())
    assert {row["policy"] for row in table["summary"]} >= {
        "direct transfer",
        "phase (the paper's UGAT)",
    }
    assert {row["domain"] for row in table["summary"]} == {"sim", "V4"}
    assert table["scenario_hash"] == load_scenario("single-v1").hash
    metrics = Metrics.read(unbroken / "metrics.parquet")
    names = {name for stage, _, name, _ in metrics.rows if stage == "iteration"}
    for name in (
        "forward/error", "forward/no_change", "forward/held_out_loss", "inverse/accuracy",
        "inverse/held_out_loss", "calibration/auroc", "calibration/error_by_quantile/0",
        "calibration/mean_u", "calibration/mean_u_off_data", "gate/acceptance",
        "gate/change_rate", "gate/alpha", "gate/alpha/signal_0", "att_s/sim", "att_s/V4",
    ):  # fmt: skip
        assert name in names, name
    episodes = [step for stage, step, name, _ in metrics.rows if (stage, name) == ("episode", "return")]  # fmt: skip  # noqa: E501
    assert episodes == list(range(12 + 2 * 2))
    assert list(unbroken.glob("trainings/*/tensorboard/events*"))
    assert not np.array_equal(weights(unbroken, "phase"), weights(unbroken, "direct-transfer"))


def test_alpha_starts_infinite_and_then_is_the_mean_of_u(unbroken: Path) -> None:
    rows = {(step, name): value for _, step, name, value in Metrics.read(unbroken / "metrics.parquet").rows}  # fmt: skip  # noqa: E501
    assert rows[1, "gate/alpha"] == np.inf
    assert rows[1, "gate/acceptance"] == 1.0
    assert rows[2, "gate/alpha"] == pytest.approx(rows[1, "gate/mean_u"])


@pytest.mark.usefixtures("unjudged")
def test_alpha_can_start_at_what_the_first_fit_expects(tmp_path: Path) -> None:
    few = replace(SMALL.ugat, iterations=1, grounded_episodes=1, gate=GateConfig(start="fitted"))
    transfer(replace(SMALL, ugat=few), tmp_path / "run")
    rows = {name: value for *_, name, value in Metrics.read(tmp_path / "run/metrics.parquet").rows}
    assert rows["gate/alpha"] == pytest.approx(rows["mean_u_on_predictions"])
    assert rows["gate/acceptance"] < 1.0


@pytest.mark.slow
@pytest.mark.usefixtures("unjudged")
def test_lessons_of_a_rule_count_in_no_gate(tmp_path: Path) -> None:
    transfer(replace(SMALL, learner="universal"), tmp_path / "run")
    rows = {(step, name): value for _, step, name, value in Metrics.read(tmp_path / "run/metrics.parquet").rows}  # fmt: skip  # noqa: E501
    decisions = SMALL.ugat.grounded_episodes * 10  # of 10 s each, in 100 s
    assert [rows[k, "gate/decisions"] for k in (1, 2)] == [decisions, decisions]


def test_a_resumed_run_is_an_unbroken_one_byte_for_byte(unbroken: Path, tmp_path: Path) -> None:
    """One run is interrupted at four moments, and taken up again after each."""
    folder = tmp_path / "run"
    for moment in (
        "plain sim, episode 11-12", "roll-outs, iteration 1", "fitting f and h, iteration 2",
        "grounded, iteration 2",
    ):  # fmt: skip
        with pytest.raises(KeyboardInterrupt):
            transfer(LONG, folder, resume=folder.exists(), reporter=KillAt(moment))
    transfer(LONG, folder, resume=True)
    one, two = contents(folder), contents(unbroken)
    assert [name for name in one.keys() | two.keys() if one.get(name) != two.get(name)] == []
    assert {"table.json", "metrics.parquet", "queues.parquet", "policies/phase.pt"} <= one.keys()
    for ending in ("checkpoint/learner.pt", "tensorboard/events.out.tfevents.run"):
        assert any(name.endswith(ending) for name in one), ending


def contents(run: Path) -> dict[str, bytes]:
    """The bytes of every file of a run."""
    return {
        str(path.relative_to(run)): path.read_bytes() for path in run.rglob("*") if path.is_file()
    }


def short_of(method: MethodName) -> TransferConfig:
    fit = FitConfig(uncertainty=method, epochs=2, members=2, passes=3)
    return replace(SMALL, ugat=replace(SMALL.ugat, grounded_episodes=1, fit=fit))


@pytest.mark.usefixtures("unjudged")
@pytest.mark.parametrize("method", ["ensemble", "none"])
def test_every_uncertainty_trains(method: MethodName, tmp_path: Path) -> None:
    transfer(short_of(method), tmp_path)
    metrics = Metrics.read(tmp_path / "metrics.parquet").rows
    rows = {(step, name): value for _, step, name, value in metrics}
    assert 0 <= rows[2, "calibration/ece"] <= 1
    if method == "none":
        assert rows[1, "gate/mean_u"] == rows[2, "gate/mean_u"] == 0.0
        assert rows[1, "gate/acceptance"] == rows[2, "gate/acceptance"] == 1.0
    else:
        assert rows[2, "gate/alpha"] == pytest.approx(rows[1, "gate/mean_u"])


@pytest.mark.slow
@pytest.mark.usefixtures("unjudged")
def test_a_run_with_dropout_resumes(tmp_path: Path) -> None:
    """Its thinned networks are part of the checkpoint, and are not those of a fresh grounding."""
    config = short_of("dropout")
    with pytest.raises(KeyboardInterrupt):
        transfer(config, tmp_path / "run", reporter=KillAt("fitting f and h, iteration 2"))
    transfer(config, tmp_path / "run", resume=True)
    transfer(config, tmp_path / "unbroken")
    one, two = (pl.read_parquet(tmp_path / n / "metrics.parquet") for n in ("run", "unbroken"))
    assert one.equals(two)


@pytest.mark.slow
def test_a_killed_process_resumes(
    tmp_path: Path, python: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    command = [
        "train", "single-v1", "--duration-s", "100", "--out", str(folder), "--pretrain-episodes",
        "11", "--iterations", "1", "--grounded-episodes", "1",
        "--real-rollouts", "2", "--no-control", "--evaluation-seeds", "1",
        "--tuning-seeds", "1", "--learner", "dqn", "--street.simulations", "20",
        "--street.judged", "1",
    ]  # fmt: skip
    process = subprocess.Popen(
        [*python, "-m", "ugat_marl", *command], stdout=subprocess.DEVNULL, start_new_session=True
    )
    deadline = time.monotonic() + 120
    while not list(folder.glob("trainings/*/checkpoint/state.json")):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    state = json.loads((checkpoint_of(folder) / "state.json").read_text())
    assert state["pretrained"] == 10
    assert main([*command, "--resume"]) == 0
    assert "direct transfer" in capsys.readouterr().out
    assert main(command) == 2
    assert "--resume" in capsys.readouterr().err


def cut_in_half(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def spoil(path: Path) -> None:
    content = torch.load(path, weights_only=True)
    content["tensors"]["weights"][0] = float("nan")
    torch.save(content, path)


@pytest.mark.parametrize(
    ("file", "damage", "error"),
    [
        ("learner.pt", cut_in_half, CheckpointError),
        ("learner.pt", spoil, CheckpointError),
        ("grounding.pt", cut_in_half, CheckpointError),
        ("real-000.parquet", cut_in_half, LogError),
        ("metrics.parquet", cut_in_half, CheckpointError),
    ],
)
def test_a_damaged_checkpoint_is_named_and_left_alone(
    file: str,
    damage: Callable[[Path], None],
    error: type[Exception],
    unbroken: Path,
    tmp_path: Path,
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(unbroken, folder)
    damage(checkpoint_of(folder) / file)
    (checkpoint_of(folder).parent / "scores.json").unlink()  # nothing reads on in a finished job
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    with pytest.raises(error, match=file):
        transfer(LONG, folder, resume=True)
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before


def test_a_run_of_another_scenario_is_refused(unbroken: Path) -> None:
    other = replace(LONG, scenario="grid2x2-v1")
    with pytest.raises(CheckpointError, match="holds another run: its scenario"):
        transfer(other, unbroken, resume=True)
    with pytest.raises(OptionError, match="--resume"):
        transfer(LONG, unbroken)


def recorded(path: Path, scenario: str = "single-v1", observation: str = "count") -> Path:
    probe = parallel_env(scenario, "V4", duration_s=100)
    rule = make_rule("largest-queue:20", probe)
    env = parallel_env(scenario, "V4", duration_s=100, **rule.env_options)
    logs: list[TransitionLog] = []
    for seed in (1, 2):
        log = roll_out(
            env, EpsilonGreedy(rule, 0.3), seed, record=observer_of(env, observation)
        ).log
        assert log is not None
        logs.append(log)
    env.close()
    TransitionLog.concatenate(logs).write(path)
    return path


def test_a_recorded_log_takes_the_place_of_the_real_simulator(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = recorded(tmp_path / "real.parquet")
    played: set[str] = set()
    collect = SimulatedWorld.collect

    def noting(self: Any, *args: Any) -> Any:
        played.add(self._name)
        return collect(self, *args)

    monkeypatch.setattr(SimulatedWorld, "collect", noting)
    found = transfer(replace(SMALL, real="none", real_log=log), tmp_path / "run")
    assert played == {"sim"}
    assert found.domains == ["sim"]


def test_a_log_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    for name, log in (
        ("agents", recorded(tmp_path / "grid.parquet", "grid2x2-v1")),
        ("observation", recorded(tmp_path / "queue.parquet", observation="queue")),
    ):
        config = TransferConfig("single-v1", real="none", real_log=log, duration_s=100)
        with pytest.raises(LogError, match=name):
            transfer(config, tmp_path / f"run-{name}")
    short = recorded(tmp_path / "short.parquet", observation="movements")
    whole = TransitionLog.read(short)
    for name, rows in (("no row", 0), ("right before them", 1)):
        TransitionLog(whole.provenance, whole.frame.head(rows)).write(short)
        config = TransferConfig("single-v1", real="none", real_log=short, duration_s=100)
        with pytest.raises(LogError, match=name):
            transfer(config, tmp_path / f"run-{name}")
        assert not (tmp_path / f"run-{name}").exists(), "before anything is trained"
    cut_in_half(tmp_path / "queue.parquet")
    config = TransferConfig("single-v1", real="none", real_log=tmp_path / "queue.parquet")
    with pytest.raises(LogError, match=r"queue\.parquet"):
        transfer(config, tmp_path / "run")
    with pytest.raises(OptionError, match="real_log"):
        TransferConfig("single-v1", real="none")


@pytest.mark.usefixtures("unjudged")
def test_the_control_starts_from_direct_transfer(tmp_path: Path) -> None:
    ugat = replace(SMALL.ugat, iterations=1, grounded_episodes=1)
    found = transfer(replace(SMALL, control=True, ugat=ugat), tmp_path / "run")
    assert "more plain sim" in found.policies
    direct = weights(tmp_path / "run", "direct-transfer")
    assert not np.array_equal(direct, weights(tmp_path / "run", "more-plain-sim"))


@pytest.fixture(scope="module")
def repaired(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A corrected scenario as a diagnosis writes it."""
    folder = tmp_path_factory.mktemp("diagnosis") / "corrected"
    return scenario_in_domain(load_scenario("single-v1"), "acceleration=0.6").write(folder)


SHORT = replace(
    SMALL, ugat=replace(SMALL.ugat, pretrain_episodes=8, iterations=1, grounded_episodes=4)
)


@pytest.mark.slow
def test_a_policy_trained_in_the_corrected_sim_stands_beside_the_others(
    repaired: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    late = "late_green=*,2"
    config = replace(SHORT, corrected=str(repaired), control=True, further=(late, "V4"))
    trained: list[tuple[str, int]] = []
    learn = DQN.learn

    def counting(self: Any, env: Any, episodes: int, *rest: Any) -> Any:
        trained.append((getattr(env, "domain", "grounded"), episodes))
        return learn(self, env, episodes, *rest)

    monkeypatch.setattr(DQN, "learn", counting)
    found = transfer(config, tmp_path / "run", workers=1)  # else in processes of their own
    names = ["direct transfer", "phase (the paper's UGAT)", "more plain sim"]
    further = [f"further in {late}", "further in V4"]
    assert found.policies[:6] == [*names, *further, "corrected sim"]
    for name in (late, "V4"):  # from where direct transfer stood, as long as the control
        assert sum(episodes for domain, episodes in trained if domain == name) == 4
    assert found.domains == ["sim", "V4"]
    assert found.notes["corrected sim"] == str(repaired)
    assert {r.seed for r in found.results if r.policy == "corrected sim"} == {
        r.seed for r in found.results if r.policy == "phase (the paper's UGAT)"
    }
    there = [episodes for domain, episodes in trained if domain == str(repaired)]
    assert sum(there) == config.episodes == 12
    mine = weights(tmp_path / "run", "corrected-sim")
    for other in ("phase", "direct-transfer", "more-plain-sim", "further-in-v4"):
        assert not np.array_equal(mine, weights(tmp_path / "run", other))


@pytest.mark.slow
@pytest.mark.usefixtures("unjudged")
def test_training_in_the_corrected_sim_resumes(repaired: Path, tmp_path: Path) -> None:
    config = replace(SHORT, corrected=str(repaired))
    transfer(config, tmp_path / "unbroken", workers=1)

    killed = KillAfter("training: corrected sim", 11)
    with pytest.raises(KeyboardInterrupt):
        transfer(config, tmp_path / "run", reporter=killed, workers=1)
    (kept,) = (tmp_path / "run" / "trainings").glob("*-scratch-*/learner.pt")
    assert kept.stat().st_size, "nothing was kept of ten episodes"
    moved = shutil.copytree(repaired, tmp_path / "elsewhere")
    transfer(replace(config, corrected=str(moved)), tmp_path / "run", resume=True)
    first, again = (weights(tmp_path / name, "corrected-sim") for name in ("unbroken", "run"))
    assert np.array_equal(first, again)


@pytest.mark.slow
@pytest.mark.usefixtures("unjudged")
def test_another_correction_is_trained_for_itself(repaired: Path, tmp_path: Path) -> None:
    """It is a control: one may be added to a finished run, and each has its own training."""
    found = []
    for corrected in (None, str(repaired), "acceleration=0.7", str(repaired)):
        config = replace(SHORT, corrected=corrected)
        transfer(config, tmp_path / "run", resume=bool(found))
        kept = tmp_path / "run" / "policies" / "corrected-sim.pt"
        found.append(kept.read_bytes() if kept.exists() else None)
    assert found[0] is None
    assert found[1] == found[3] != found[2]


def test_a_correction_that_cannot_be_trained_in_is_refused_at_once(
    repaired: Path, tmp_path: Path
) -> None:
    with pytest.raises(OptionError, match="the simulation itself"):
        replace(SMALL, corrected="sim")
    with pytest.raises(UnknownNameError, match="no-such-directory"):
        transfer(replace(SMALL, corrected="no-such-directory"), tmp_path / "run")
    fewer = scenario_in_domain(load_scenario("single-v1"), "sim").with_control(phases="programme")
    fewer.write(tmp_path / "fewer")
    with pytest.raises(ScenarioError, match="has other phases than scenario"):
        transfer(replace(SMALL, corrected=str(tmp_path / "fewer")), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.usefixtures("unjudged")
def test_models_that_are_too_poor_are_not_obeyed(tmp_path: Path) -> None:
    ugat = replace(SMALL.ugat, pretrain_episodes=1, iterations=1, least_accuracy=1.0)
    transfer(replace(SMALL, ugat=ugat), tmp_path / "run")
    rows = {n: v for _, _, n, v in Metrics.read(tmp_path / "run" / "metrics.parquet").rows}
    assert rows["inverse/accuracy"] < 1.0
    assert rows["gate/acceptance"] == 0.0
    with pytest.raises(OptionError, match="least_accuracy"):
        UgatConfig(least_accuracy=1.5)


@pytest.mark.slow
def test_another_directory_can_be_the_real_world(tmp_path: Path) -> None:
    street = load_scenario("single-v1").write(tmp_path / "street")
    config = replace(
        SMALL, real=str(street), ugat=replace(SMALL.ugat, pretrain_episodes=1, iterations=1)
    )
    found = transfer(config, tmp_path / "run")
    assert found.domains == ["sim", str(street)]


def test_what_is_refused_leaves_the_folder_free(tmp_path: Path) -> None:
    log = recorded(tmp_path / "grid.parquet", "grid2x2-v1")
    config = replace(SMALL, real="none", real_log=log)
    with pytest.raises(LogError, match="agents"):
        transfer(config, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_two_processes_do_not_train_in_one_folder(tmp_path: Path) -> None:
    (tmp_path / "run" / "trainings").mkdir(parents=True)
    with (
        contextlib.closing(lock_folder(tmp_path / "run" / "trainings")),
        pytest.raises(OptionError, match="another process"),
    ):
        transfer(SMALL, tmp_path / "run")
    run = Run(tmp_path / "job", {"a": 1}, Silent())
    with pytest.raises(OptionError, match="another process"):
        Run(tmp_path / "job", {"a": 1}, Silent())
    run.close()
    Run(tmp_path / "job", {"a": 1}, Silent()).close()


def test_a_refused_run_leaves_its_folder_free(tmp_path: Path) -> None:
    run = Run(tmp_path, {"a": 1}, Silent())
    run.save({}, lambda folder: None)
    run.close()
    with pytest.raises(CheckpointError) as kept:  # as a notebook keeps the last error
        Run(tmp_path, {"a": 2}, Silent())
    Run(tmp_path, {"a": 1}, Silent()).close()
    assert kept.value.__traceback__ is not None


@pytest.mark.usefixtures("unjudged")
def test_a_changed_log_is_another_run(tmp_path: Path) -> None:
    log = recorded(tmp_path / "real.parquet")
    ugat = replace(SMALL.ugat, pretrain_episodes=1, iterations=1)
    config = replace(SMALL, real="none", real_log=log, ugat=ugat)
    transfer(config, tmp_path / "run")
    moved = tmp_path / "moved.parquet"
    shutil.copy(log, moved)
    transfer(replace(config, real_log=moved), tmp_path / "run", resume=True)
    TransitionLog.concatenate([TransitionLog.read(log)] * 2).write(log)
    with pytest.raises(CheckpointError, match="real_log"):
        transfer(config, tmp_path / "run", resume=True)


def test_a_failed_roll_out_ends_the_other_one() -> None:
    """The street fails before the simulation begins, which goes on until it is stopped."""

    class Failing:
        def collect(self, *_: object) -> TransitionLog:
            raise LogError("the street does not answer")

        def stop(self) -> None:
            pass

    class Endless:
        def __init__(self) -> None:
            self.ended = threading.Event()

        def collect(self, *_: object) -> None:
            time.sleep(0.5)
            self.ended.clear()  # as each roll-out of a simulation does
            if not self.ended.wait(60):
                raise TimeoutError

        def stop(self) -> None:
            self.ended.set()

    endless, state = Endless(), SimpleNamespace(iteration=0, stage="real", simulated=[], real=[])
    training: Any = SimpleNamespace(
        sim=endless, real=Failing(), seed=0, run=SimpleNamespace(reporter=Silent())
    )
    begun = time.monotonic()
    with pytest.raises(LogError, match="does not answer"):
        Ugat._roll_out(training, state, None)  # pyright: ignore[reportArgumentType]
    assert endless.ended.is_set() and time.monotonic() - begun < 30
