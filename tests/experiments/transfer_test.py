"""Controls and negative controls of `train`: what each is trained in, from what, for how long."""

from __future__ import annotations

import contextlib
import json
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
import polars as pl
import pytest
import torch

from tests.interrupts import KillAfter
from tests.runs import SMALL, checkpoint_of, numbers, play_nothing, weights
from ugat_marl.__main__ import main
from ugat_marl.data import CHECKPOINT_FOLDER, SETTINGS_FILE, TransitionLog
from ugat_marl.data.runs import IDENTITY_FILE
from ugat_marl.effects import load_scenario
from ugat_marl.envs import TrafficEnv, parallel_env
from ugat_marl.errors import CheckpointError, LogError, OptionError, UnknownNameError
from ugat_marl.experiments import (
    Evaluation,
    PaperConfig,
    Setting,
    run_folder,
    transfer,
    transfers,
)
from ugat_marl.experiments.jobs import LEARNER, file_names, perform
from ugat_marl.experiments.randomised import RandomisedEnv
from ugat_marl.experiments.row_names import DIRECT, FINE_TUNED
from ugat_marl.experiments.transfers import planned_jobs
from ugat_marl.grounding import InputsConfig, RandomDelays, TimedConfig, UgatConfig
from ugat_marl.policies import UNIVERSAL_NAME, DQNConfig, make_rule, observer_of, roll_out
from ugat_marl.progress import Silent


@pytest.fixture(autouse=True)
def unjudged(monkeypatch: pytest.MonkeyPatch) -> None:
    play_nothing(monkeypatch)


def episodes(folder: Path, name: str) -> int:
    """Episodes that the learner of a setting has had, found by the name it carries."""
    jobs = {json.loads(path.read_text())["setting"]["name"]: path for path in jobs_of(folder)}
    saved = torch.load(jobs[name].parent / "learner.pt", weights_only=True)
    return int(saved["counters"]["episodes"])


def jobs_of(folder: Path) -> list[Path]:
    """Files of the jobs that are compared with UGAT."""
    trained = (folder / "trainings").glob("*/learner.pt")
    return [path.parent / "job.json" for path in trained]


def trained(table: Evaluation) -> list[str]:
    """Names of the policies of a table that are no rules."""
    return [name for name in table.policies if not name.startswith("rule ")]


CONTROLS: dict[str, Any] = {
    "control": True,
    "randomised": True,
    "random_delay_s": 5,
    "fine_tuned": True,
    "oracle": True,
}


def test_without_iterations_there_is_no_ugat_to_judge(tmp_path: Path) -> None:
    plain = replace(SMALL, ugat=replace(SMALL.ugat, iterations=0))
    assert trained(transfer(plain, tmp_path / "run")) == ["direct transfer"]
    assert [path.name for path in (tmp_path / "run/policies").iterdir()] == ["direct-transfer.pt"]


@pytest.mark.slow
def test_every_control_is_trained_as_long_as_it_says_where_it_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    worlds: list[str] = []
    late: list[int] = []
    reset, step = RandomisedEnv.reset, RandomDelays.step

    def drawing(self: Any, *args: Any, **options: Any) -> Any:
        outcome = reset(self, *args, **options)
        worlds.append(self.env.domain)
        return outcome

    def delaying(self: Any, actions: Any) -> Any:
        late.append(self._most_s)
        return step(self, actions)

    monkeypatch.setattr(RandomisedEnv, "reset", drawing)
    monkeypatch.setattr(RandomDelays, "step", delaying)
    config = replace(SMALL, **CONTROLS)
    found = transfer(config, tmp_path)
    names = [
        "direct transfer", "phase (the paper's UGAT)", "more plain sim", "random delay 0-5 s",
        "fine-tuned on the same data", "domain randomisation", "trained in real",
    ]  # fmt: skip
    assert trained(found) == names
    assert config.episodes == 6
    for name in ("more plain sim", "random delay 0-5 s", "domain randomisation", "trained in real"):
        assert episodes(tmp_path, name) == 6
    # UGAT saw two roll-outs of the real domain in each of two iterations.
    assert episodes(tmp_path, "fine-tuned on the same data") == 2 + 4
    assert len(worlds) == len(set(worlds)) == 6
    for world in worlds:
        parts = {part.partition("=")[0] for part in world.split("+")}
        assert parts == {
            "acceleration", "deceleration", "emergency_deceleration", "startup_delay",
        }  # fmt: skip
    assert set(late) == {5} and len(late) == 4 * 10  # four episodes of ten decisions
    policies = [weights(tmp_path, file) for file in file_names(names)]
    for i, one in enumerate(policies):
        assert not any(np.array_equal(one, other) for other in policies[:i])


def test_controls_are_the_trainings_that_go_by_other_names(tmp_path: Path) -> None:
    """The oracle is a correction that is right; fine-tuning goes on in the real domain."""
    # SMALL has as many grounded episodes as roll-outs of the real domain.
    config = replace(SMALL, oracle=True, fine_tuned=True, corrected="V4", further=("V4",))
    transfer(config, tmp_path)
    for one, other in (
        ("trained-in-real", "corrected-sim"),
        ("fine-tuned-on-the-same-data", "further-in-v4"),
    ):
        assert np.array_equal(weights(tmp_path, one), weights(tmp_path, other))


def test_fine_tuning_plays_as_many_real_episodes_as_it_states(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lessons and the search for their teacher would be further ones."""
    played: list[str] = []
    reset = TrafficEnv.reset

    def counted(self: TrafficEnv, *args: Any, **options: Any) -> Any:
        played.append(self.domain)
        return reset(self, *args, **options)

    learner = {"learner": UNIVERSAL_NAME, "dqn": DQNConfig(lesson_updates=1)}
    config = replace(SMALL, fine_tuned=True, **learner)
    plan = planned_jobs(config)
    (job,) = [job for job in plan if job.setting.name == FINE_TUNED]
    direct = replace(plan[0], setting=Setting(DIRECT, "direct", learner=config.spec), episodes=2)
    perform(direct, tmp_path / "direct", Silent())
    monkeypatch.setattr(TrafficEnv, "reset", counted)
    perform(replace(job, start=f"direct/{LEARNER}"), tmp_path / "tuned", Silent())
    assert played == ["V4"] * 4  # two iterations, two roll-outs each


@pytest.mark.slow
def test_domains_whose_names_differ_by_a_sign_are_trained_in_one_by_one(tmp_path: Path) -> None:
    domains = ("acceleration=0.5+demand_timing=*,-60", "acceleration=0.5+demand_timing=*,60")
    transfer(replace(SMALL, further=domains), tmp_path)
    assert len(jobs_of(tmp_path)) == 2
    first = "further-in-acceleration-0.5-demand-timing-60"
    one, two = (weights(tmp_path, name) for name in (first, f"{first}-2"))
    assert not np.array_equal(one, two)


@pytest.mark.slow
def test_controls_can_be_added_to_a_run_and_change_nothing_else(tmp_path: Path) -> None:
    transfer(SMALL, tmp_path / "run")
    policies = (
        "phase", "direct-transfer", "trained-in-real", "random-delay-0-5-s",
        "corrected-sim",
    )  # fmt: skip
    before = weights(tmp_path / "run", "phase")
    more = replace(SMALL, oracle=True, random_delay_s=5, corrected="V2")
    transfer(more, tmp_path / "run", resume=True)
    transfer(more, tmp_path / "at once")
    assert np.array_equal(before, weights(tmp_path / "run", "phase"))
    for name in policies:
        one, two = (weights(tmp_path / run, name) for run in ("run", "at once"))
        assert np.array_equal(one, two), name
    transfer(SMALL, tmp_path / "run", resume=True)
    left = {path.stem for path in (tmp_path / "run" / "policies").glob("*.pt")}
    assert left == {"phase", "direct-transfer"}, "files of rows that the table has no more"


def test_the_folder_is_locked_until_the_table_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second run begins while the first one, already trained and judged, writes its table."""
    refused: list[str] = []

    def write(*_: Any) -> str:
        with pytest.raises(OptionError, match="another process is training in this folder") as told:
            transfer(SMALL, tmp_path / "run", resume=True)
        refused.append(str(told.value))
        return "table"

    def perform(*_: Any, **_options: Any) -> list[Any]:
        return []

    monkeypatch.setattr(transfers, "perform_here", perform)
    monkeypatch.setattr(transfers, "_write_results", write)
    for _ in range(2):  # the first one has freed the folder
        transfer(SMALL, tmp_path / "run", resume=True)
    assert len(refused) == 2


def test_a_run_that_goes_on_with_another_libsumo_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []

    class Told(Silent):
        def say(self, line: str) -> None:
            said.append(line)

    monkeypatch.setattr(transfers, "perform_here", lambda *_, **_options: [])
    monkeypatch.setattr(transfers, "_write_results", lambda *_: "table")
    transfer(SMALL, tmp_path)
    begun = tmp_path / "trainings" / "any" / CHECKPOINT_FOLDER
    begun.mkdir(parents=True)
    transfer(SMALL, tmp_path, resume=True, reporter=Told())
    assert not [line for line in said if "began with" in line]
    file = tmp_path / SETTINGS_FILE
    settings = json.loads(file.read_text())
    settings["versions"]["libsumo"] = "0.9"
    file.write_text(json.dumps(settings))
    transfer(SMALL, tmp_path, resume=True, reporter=Told())
    (note,) = (line for line in said if "began with" in line)
    assert note == f"note: this run began with libsumo 0.9, and goes on with {version('libsumo')}"


@pytest.mark.slow
def test_domain_randomisation_resumes(tmp_path: Path) -> None:
    ugat = replace(SMALL.ugat, pretrain_episodes=8, iterations=1, grounded_episodes=4)
    config = replace(SMALL, ugat=ugat, randomised=True)
    transfer(config, tmp_path / "unbroken")
    with pytest.raises(KeyboardInterrupt):
        transfer(config, tmp_path / "run", reporter=KillAfter("training: domain randomisation", 11))
    assert episodes(tmp_path / "run", "domain randomisation") == 10
    (job,) = (tmp_path / "run").glob("trainings/*randomised*")
    (job / ".queues.parquet.abc.tmp").touch()  # of a process that was killed
    transfer(config, tmp_path / "run", resume=True)
    assert list(job.glob(".*.tmp")) == []
    name = "domain-randomisation"
    assert np.array_equal(weights(tmp_path / "run", name), weights(tmp_path / "unbroken", name))


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"seed": -1}, "seed = -1: must be at least 0"),
        ({"random_delay_s": 0}, "random_delay_s = 0: must be at least 1"),
        ({"real": "none", "real_log": Path("x"), "oracle": True}, "oracle needs a real domain"),
        ({"real": "none", "real_log": Path("x"), "fine_tuned": True}, "needs a real domain"),
        ({"real_log": Path("x"), "fine_tuned": True}, "which a real_log does not allow"),
        (
            {"real_log": Path("x"), "ugat": UgatConfig("timed", timed=TimedConfig(match=True))},
            "timed match acts in the real domain",
        ),
        ({"real": "sim"}, '"same-world"'),
        ({"real": "sim", "negative_control": "noise"}, "is the simulation itself"),
        (
            {"real": "sim", "negative_control": "same-world", "oracle": True},
            "oracle needs a real domain",
        ),
        ({"negative_control": "same-world", "real_log": Path("x")}, "leave out one of them"),
        ({"further": ("V2", "SIM"), "control": True}, "is what the control does"),
        ({"further": ("sim",), "control": False}, "is what the control does.*use the control"),
        ({"further": ("V4", "snow")}, "further holds one twice: V4 V4"),
    ],
)
def test_what_makes_no_sense_is_refused(options: dict[str, Any], complaint: str) -> None:
    with pytest.raises(OptionError, match=complaint):
        replace(SMALL, **options)
    with pytest.raises(UnknownNameError, match=r"negative control 'shufled'.*'shuffled'"):
        replace(SMALL, negative_control="shufled")  # pyright: ignore[reportArgumentType]


def test_a_domain_under_another_name_is_the_same_run() -> None:
    aliases = replace(SMALL, real="Snow", sim=" SIM ", further=("rain",), corrected="rain")
    assert aliases == replace(SMALL, real="V4", sim="sim", further=("V3",), corrected="V3")
    assert PaperConfig(sim="snow", domains=("V1",)) == PaperConfig(sim="V4", domains=("V1",))
    assert run_folder(aliases).name == "single-v1-V4-s0"


def follows(folder: Path) -> float:
    """Share of the rows of D_real after which the next row begins where they ended."""
    log = TransitionLog.read(checkpoint_of(folder) / "real-000.parquet")
    rows = log.transitions("signal_0")
    goes_on = rows.episode[1:] == rows.episode[:-1]
    same = (rows.next_observation[:-1] == rows.observation[1:]).all(1)
    return float(same[goes_on].mean())


def test_with_the_same_world_nothing_real_is_ever_seen(tmp_path: Path) -> None:
    alone = transfer(replace(SMALL, real="sim", negative_control="same-world"), tmp_path / "alone")
    assert alone.domains == ["sim"]
    judged = transfer(replace(SMALL, negative_control="same-world"), tmp_path / "judged")
    assert judged.domains == ["sim", "V4"]
    for run in ("alone", "judged"):
        log = TransitionLog.read(checkpoint_of(tmp_path / run) / "real-000.parquet")
        assert log.provenance.domain == "sim" and follows(tmp_path / run) == 1.0
    # Where a policy is judged decides nothing about its training.
    assert np.array_equal(
        weights(tmp_path / "alone", "phase"), weights(tmp_path / "judged", "phase")
    )


def test_shuffled_data_of_the_street_lead_nowhere(tmp_path: Path) -> None:
    transfer(replace(SMALL, negative_control="shuffled"), tmp_path / "run")
    assert follows(tmp_path / "run") < 0.4
    with pytest.raises(CheckpointError, match="its negative_control"):
        transfer(SMALL, tmp_path / "run", resume=True)


@pytest.mark.slow
def test_a_run_with_noise_for_f_says_so_and_resumes(tmp_path: Path) -> None:
    config = replace(SMALL, negative_control="noise")
    transfer(config, tmp_path / "unbroken")
    assert numbers(tmp_path / "unbroken")[2, "forward/ratio"] > 1.2
    with pytest.raises(KeyboardInterrupt):
        transfer(config, tmp_path / "run", reporter=KillAfter("grounded, iteration 2", 2))
    transfer(config, tmp_path / "run", resume=True)
    one, two = (pl.read_parquet(tmp_path / n / "metrics.parquet") for n in ("run", "unbroken"))
    assert one.equals(two)


@pytest.mark.parametrize("crossings", [True, False])
def test_timed_grounding_learns_from_a_log_of_fixed_time(crossings: bool, tmp_path: Path) -> None:
    """The street was driven by another controller, and nobody explored."""
    path = tmp_path / "fixed.parquet"
    call = ["rollout", "single-v1", "--domain", "V4", "--policy", "fixed-time:30", "--out"]
    call += [str(path), "--epsilon", "0", "--episodes", "2", "--duration-s", "300"]
    call += ["--observation", "count", "--crossings" if crossings else "--no-crossings"]
    assert main(call) == 0
    log = TransitionLog.read(path)
    rows, layout = log.transitions("signal_0"), log.provenance.layouts["signal_0"]
    assert rows.served_features.shape == (60, layout.features if crossings else 0)
    assert np.array_equal(rows.action, rows.executed)
    assert [len(set(rows.action[k : k + 3])) for k in range(0, 30, 3)] == [1] * 10
    ugat = replace(SMALL.ugat, grounding="timed", iterations=1)
    transfer(replace(SMALL, real_log=path, ugat=ugat), tmp_path / "run")
    begun = (rows.observation[:, -layout.phases :].argmax(1) != rows.executed).sum()
    assert begun == 2 * 9  # every 30 s but at the beginning
    kept = TransitionLog.read(checkpoint_of(tmp_path / "run") / "real-000.parquet")
    assert kept.frame.equals(log.frame)
    assert not (checkpoint_of(tmp_path / "run") / "real-001.parquet").exists()
    found = numbers(tmp_path / "run")
    assert 0 <= found[1, "lost_time/low_s"] <= found[1, "lost_time/best_s"] <= 5


def test_a_log_that_models_of_neighbours_cannot_read_is_refused_before_training(
    tmp_path: Path,
) -> None:
    with contextlib.closing(parallel_env("grid2x2-v1", duration_s=100)) as env:
        rule = make_rule("fixed-time:20", env)
        played = [roll_out(env, rule, seed, record=observer_of(env)).log for seed in (1, 2)]
    log = TransitionLog.concatenate([one for one in played if one is not None])
    lost = (pl.col("agent") == "signal_1") & (pl.col("step") == 3)
    TransitionLog(log.provenance, log.frame.filter(~lost)).write(tmp_path / "street.parquet")
    ugat = replace(SMALL.ugat, inputs=InputsConfig(hops=1))
    config = replace(SMALL, scenario="grid2x2-v1", real_log=tmp_path / "street.parquet", ugat=ugat)
    with pytest.raises(LogError, match="at other times than of signal_0"):
        transfer(config, tmp_path / "run")
    assert not (tmp_path / "run" / "trainings").exists()


def test_names_of_policies_are_names_of_files_of_their_own() -> None:
    names = ["direct transfer", "further in a=-1", "further in a=1", "further in a-1"]
    expected = ["direct-transfer", "further-in-a-1", "further-in-a-1-2", "further-in-a-1-3"]
    assert file_names(names) == expected


@pytest.mark.parametrize("grounding", ["timed", "street"])
def test_a_queue_model_that_shows_no_crossings_is_refused_at_once(
    grounding: Literal["timed", "street"], tmp_path: Path
) -> None:
    config = replace(SMALL, sim="meso", ugat=UgatConfig(grounding))
    with pytest.raises(OptionError, match="use the grounding phase, or no iterations"):
        transfer(config, tmp_path / "run")
    assert not (tmp_path / "run" / "trainings").exists()


@pytest.mark.parametrize("place", ["sim", "real"])
def test_a_directory_is_judged_at_the_length_that_is_played(
    place: Literal["sim", "real"], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its demand surges after its own end, and before that of the episodes played."""
    directory = load_scenario(SMALL.scenario).with_duration(40).write(tmp_path / "surge")
    with (directory / "scenario.toml").open("a") as file:
        file.write(
            '\n[[effects]]\nname = "demand_surge"\n'
            'edge = "*"\nbegin_s = 50.0\nend_s = 90.0\nfactor = 1.5\n'
        )
    monkeypatch.setattr(transfers, "perform_here", lambda *_, **_options: [])
    monkeypatch.setattr(transfers, "_write_results", lambda *_: "table")
    domain = {"sim": "sim", "real": "V4", place: str(directory)}
    transfer(replace(SMALL, **domain, ugat=UgatConfig("street")), tmp_path / "run")
    hashes = json.loads((tmp_path / "run" / IDENTITY_FILE).read_text())["scenario_hash"]
    played = parallel_env(SMALL.scenario, str(directory), duration_s=SMALL.duration_s)
    assert hashes[place] == played.scenario.hash
