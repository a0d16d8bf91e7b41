"""Algorithm 1 on a real scenario: what is stored, what is resumed, what is refused."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import torch

from tests.runs import checkpoint_of, search_few_rules
from ugat_marl.data import Metrics, Run, TransitionLog, lock_folder
from ugat_marl.effects import load_scenario, scenario_in_domain
from ugat_marl.envs import parallel_env
from ugat_marl.errors import CheckpointError, LogError, OptionError, ScenarioError, UnknownNameError
from ugat_marl.experiments import TransferConfig, transfer
from ugat_marl.grounding import FitConfig, GateConfig, SimulatedWorld, UgatConfig
from ugat_marl.grounding.uncertainty import MethodName
from ugat_marl.policies import (
    DQN,
    DQNConfig,
    EpsilonGreedy,
    NetworkPolicy,
    make_rule,
    observer_of,
    roll_out,
)
from ugat_marl.progress import Silent

SMALL = TransferConfig(
    scenario="single-v1",
    real="V4",
    duration_s=100,
    evaluation_seeds=1,
    tuning_seeds=1,
    control=False,
    ugat=UgatConfig(
        pretrain_episodes=12,
        iterations=2,
        grounded_episodes=2,
        sim_rollouts=2,
        real_rollouts=2,
        least_accuracy=None,  # so little training proves nothing
        fit=FitConfig(epochs=3),
    ),
    dqn=DQNConfig(warmup_decisions=20, epsilon_decay_decisions=100),
)
FEW_RULES = ("largest-queue:20", "programme")


@pytest.fixture(autouse=True)
def few_rules(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search for the best rule is not under test here."""
    search_few_rules(monkeypatch, *FEW_RULES)


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run nobody disturbs."""
    folder = tmp_path_factory.mktemp("unbroken") / "run"
    with pytest.MonkeyPatch.context() as patch:
        search_few_rules(patch, *FEW_RULES)
        transfer(SMALL, folder)
    return folder


class Killed(Exception):
    """Stands for a kill at one moment."""


class KillAt(Silent):
    """Raises when the n-th task of a name begins."""

    def __init__(self, name: str) -> None:
        self._name = name

    def task(self, name: str, total: int) -> Any:
        if name == self._name:
            raise Killed
        return super().task(name, total)


def weights(folder: Path, name: str) -> np.ndarray[Any, Any]:
    return NetworkPolicy.load(folder / "policies" / f"{name}.pt").parameters


def test_a_run_leaves_what_it_promises(unbroken: Path) -> None:
    table = json.loads((unbroken / "table.json").read_text())
    assert {row["policy"] for row in table["summary"]} >= {"direct transfer", "UGAT"}
    assert {row["domain"] for row in table["summary"]} == {"sim", "V4"}
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
    assert not np.array_equal(weights(unbroken, "ugat"), weights(unbroken, "direct-transfer"))


def test_alpha_starts_infinite_and_then_is_the_mean_of_u(unbroken: Path) -> None:
    rows = {(step, name): value for _, step, name, value in Metrics.read(unbroken / "metrics.parquet").rows}  # fmt: skip  # noqa: E501
    assert rows[1, "gate/alpha"] == np.inf
    assert rows[1, "gate/acceptance"] == 1.0
    assert rows[2, "gate/alpha"] == pytest.approx(rows[1, "gate/mean_u"])


def test_alpha_can_start_at_what_the_first_fit_expects(tmp_path: Path) -> None:
    few = replace(
        SMALL.ugat, pretrain_episodes=2, iterations=1, grounded_episodes=1,
        gate=GateConfig(start="fitted"),
    )  # fmt: skip
    transfer(replace(SMALL, ugat=few), tmp_path / "run")
    rows = {name: value for *_, name, value in Metrics.read(tmp_path / "run/metrics.parquet").rows}
    assert rows["gate/alpha"] == pytest.approx(rows["mean_u_on_predictions"])
    assert rows["gate/acceptance"] < 1.0


@pytest.mark.parametrize(
    "moment",
    [
        "plain sim, episode 11-12",
        "roll-outs, iteration 1",
        "fitting f and h, iteration 2",
        "grounded, iteration 2",
    ],
)
def test_resuming_gives_the_numbers_of_an_unbroken_run(
    moment: str, unbroken: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    with pytest.raises(Killed):
        transfer(SMALL, folder, reporter=KillAt(moment))
    transfer(SMALL, folder, resume=True)
    for name in ("metrics.parquet",):
        assert pl.read_parquet(folder / name).equals(pl.read_parquet(unbroken / name))
    assert np.array_equal(weights(folder, "ugat"), weights(unbroken, "ugat"))
    assert (folder / "table.json").read_text() == (unbroken / "table.json").read_text()


def short_of(method: MethodName) -> TransferConfig:
    fit = FitConfig(uncertainty=method, epochs=2, members=2, passes=3)
    ugat = replace(SMALL.ugat, pretrain_episodes=2, grounded_episodes=1, fit=fit)
    return replace(SMALL, duration_s=100, ugat=ugat)


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


def test_a_run_with_dropout_resumes(tmp_path: Path) -> None:
    """Its thinned networks are part of the checkpoint, and are not those of a fresh grounding."""
    config = short_of("dropout")
    with pytest.raises(Killed):
        transfer(config, tmp_path / "run", reporter=KillAt("fitting f and h, iteration 2"))
    transfer(config, tmp_path / "run", resume=True)
    transfer(config, tmp_path / "unbroken")
    one, two = (pl.read_parquet(tmp_path / n / "metrics.parquet") for n in ("run", "unbroken"))
    assert one.equals(two)


def test_a_killed_process_resumes(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    command = [
        sys.executable, "-m", "ugat_marl", "train", "single-v1", "--duration-s", "60", "--out",
        str(folder), "--pretrain-episodes", "11", "--iterations", "1", "--grounded-episodes", "1",
        "--fit.epochs", "2", "--no-control", "--evaluation-seeds", "1", "--tuning-seeds", "1",
    ]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True)
    deadline = time.monotonic() + 120
    while not list(folder.glob("trainings/*/checkpoint/state.json")):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    state = json.loads((checkpoint_of(folder) / "state.json").read_text())
    assert state["pretrained"] == 10
    done = subprocess.run([*command, "--resume"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "direct transfer" in done.stdout
    again = subprocess.run(command, capture_output=True, text=True, check=False)
    assert again.returncode == 2
    assert "--resume" in again.stderr


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
        transfer(SMALL, folder, resume=True)
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before


def test_a_run_of_another_scenario_is_refused(unbroken: Path) -> None:
    other = TransferConfig("grid2x2-v1", duration_s=100, ugat=SMALL.ugat, dqn=SMALL.dqn)
    with pytest.raises(CheckpointError, match="holds another run: its scenario"):
        transfer(other, unbroken, resume=True)
    with pytest.raises(OptionError, match="--resume"):
        transfer(SMALL, unbroken)


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
    config = TransferConfig(
        "single-v1", real="none", real_log=log, duration_s=100, evaluation_seeds=1,
        tuning_seeds=1, control=False, ugat=SMALL.ugat, dqn=SMALL.dqn,
    )  # fmt: skip
    found = transfer(config, tmp_path / "run")
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
    short = recorded(tmp_path / "short.parquet")
    whole = TransitionLog.read(short)
    for name, rows in (("no row", 0), ("to hold out", 1)):
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


def test_the_control_starts_from_direct_transfer(tmp_path: Path) -> None:
    config = TransferConfig(
        "single-v1", duration_s=100, evaluation_seeds=1, tuning_seeds=1,
        ugat=UgatConfig(
            pretrain_episodes=2, iterations=1, grounded_episodes=1, sim_rollouts=2,
            real_rollouts=2, fit=FitConfig(epochs=1),
        ),
        dqn=DQNConfig(warmup_decisions=5),
    )  # fmt: skip
    found = transfer(config, tmp_path / "run")
    assert "more plain sim" in found.policies
    direct = weights(tmp_path / "run", "direct-transfer")
    assert not np.array_equal(direct, weights(tmp_path / "run", "more-plain-sim"))
    assert load_scenario("single-v1").hash == found.scenario_hash


@pytest.fixture(scope="module")
def repaired(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A corrected scenario as a diagnosis writes it."""
    folder = tmp_path_factory.mktemp("diagnosis") / "corrected"
    return scenario_in_domain(load_scenario("single-v1"), "acceleration=0.6").write(folder)


SHORT = replace(
    SMALL, ugat=replace(SMALL.ugat, pretrain_episodes=8, iterations=1, grounded_episodes=4)
)


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
    found = transfer(config, tmp_path / "run")
    names = ["direct transfer", "UGAT", "more plain sim"]
    further = [f"further in {late}", "further in V4"]
    assert found.policies[:6] == [*names, *further, "corrected sim"]
    for name in (late, "V4"):  # from where direct transfer stood, as long as the control
        assert sum(episodes for domain, episodes in trained if domain == name) == 4
    assert found.domains == ["sim", "V4"]
    assert found.notes["corrected sim"] == str(repaired)
    assert {r.seed for r in found.results if r.policy == "corrected sim"} == {
        r.seed for r in found.results if r.policy == "UGAT"
    }
    there = [episodes for domain, episodes in trained if domain == str(repaired)]
    assert sum(there) == config.episodes == 12
    mine = weights(tmp_path / "run", "corrected-sim")
    for other in ("ugat", "direct-transfer", "more-plain-sim", "further-in-v4"):
        assert not np.array_equal(mine, weights(tmp_path / "run", other))


def test_training_in_the_corrected_sim_resumes(repaired: Path, tmp_path: Path) -> None:
    config = replace(SHORT, corrected=str(repaired))
    transfer(config, tmp_path / "unbroken")

    class KillIn(Silent):
        @contextlib.contextmanager
        def task(self, name: str, total: int) -> Any:
            with super().task(name, total) as advance:

                def one(*args: Any, **note: Any) -> None:
                    done.append(name)
                    advance(*args, **note)
                    if name == "training: corrected sim" and done.count(name) == 11:
                        raise Killed

                yield one

    done: list[str] = []
    with pytest.raises(Killed):
        transfer(config, tmp_path / "run", reporter=KillIn())
    (kept,) = (tmp_path / "run" / "trainings").glob("*-scratch-*/learner.pt")
    assert kept.stat().st_size, "nothing was kept of ten episodes"
    moved = shutil.copytree(repaired, tmp_path / "elsewhere")
    transfer(replace(config, corrected=str(moved)), tmp_path / "run", resume=True)
    first, again = (weights(tmp_path / name, "corrected-sim") for name in ("unbroken", "run"))
    assert np.array_equal(first, again)


def test_another_correction_is_another_run(repaired: Path, tmp_path: Path) -> None:
    config = replace(SHORT, corrected=str(repaired))
    transfer(config, tmp_path / "run")
    for other in ("acceleration=0.7", None):
        with pytest.raises(CheckpointError, match="its scenario_hash"):
            transfer(replace(config, corrected=other), tmp_path / "run", resume=True)


def test_a_correction_that_cannot_be_trained_in_is_refused_at_once(
    repaired: Path, tmp_path: Path
) -> None:
    with pytest.raises(OptionError, match="the simulation itself"):
        replace(SMALL, corrected="sim")
    with pytest.raises(UnknownNameError, match="no-such-directory"):
        transfer(replace(SMALL, corrected="no-such-directory"), tmp_path / "run")
    fewer = scenario_in_domain(load_scenario("single-v1"), "sim").with_control(phases="programme")
    fewer.write(tmp_path / "fewer")
    with pytest.raises(ScenarioError, match="other agents, observations or phases"):
        transfer(replace(SMALL, corrected=str(tmp_path / "fewer")), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_models_that_are_too_poor_are_not_obeyed(tmp_path: Path) -> None:
    ugat = replace(SMALL.ugat, pretrain_episodes=1, iterations=1, least_accuracy=1.0)
    transfer(replace(SMALL, ugat=ugat), tmp_path / "run")
    rows = {n: v for _, _, n, v in Metrics.read(tmp_path / "run" / "metrics.parquet").rows}
    assert rows["inverse/accuracy"] < 1.0
    assert rows["gate/acceptance"] == 0.0
    with pytest.raises(OptionError, match="least_accuracy"):
        UgatConfig(least_accuracy=1.5)


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
