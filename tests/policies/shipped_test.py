"""Shipped policies: packed from a training, read by their ids, held to their cards."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ugat_marl
from ugat_marl.__main__ import main
from ugat_marl.data import Scores
from ugat_marl.effects import load_scenario, scenario_in_domain
from ugat_marl.envs import AgentSet
from ugat_marl.errors import CheckpointError, OptionError, UnknownNameError
from ugat_marl.experiments import JobRecord, LearnerSpec, Setting, pack
from ugat_marl.experiments.jobs import POLICY, Job
from ugat_marl.policies import (
    DQN,
    DQNConfig,
    NamedRule,
    NetworkPolicy,
    PolicyCard,
    load_policy,
    policy_card,
    shipped_policies,
)
from ugat_marl.policies.shipped import FOLDER
from ugat_marl.progress import Silent

MOST_BYTES = 2_000_000
"""Most bytes of all shipped policies and their cards together: they are part of the wheel."""


def scored(att_s: float) -> Scores:
    return Scores(att_s, 2, 3, 4, 5, 6, 7, 8, 9, 10)


def tiny(seed: int) -> NetworkPolicy:
    agents = AgentSet.of(ugat_marl.parallel_env("single-v1"))
    return DQN(agents, DQNConfig(hidden=(4,)), seed).policy()


@pytest.fixture
def training(tmp_path: Path) -> Path:
    """A finished training of a tiny policy, as a job leaves it."""
    job = Job(
        Setting("direct transfer", "direct", learner=LearnerSpec("dqn")),
        "single-v1",
        seed=3,
        episodes=2,
        domains=("sim", "V4"),
        evaluation_seeds=(1000, 1001),
        options={"duration_s": None},
    )
    folder = tmp_path / "runs" / job.name
    folder.mkdir(parents=True)
    job.write(folder)
    times = {"sim": (60.0, 62.0), "V4": (100.0, 104.0)}
    record = JobRecord(
        {
            (2, domain, seed): scored(value)
            for domain, values in times.items()
            for seed, value in zip(job.evaluation_seeds, values, strict=True)
        },
        2,
    )
    record.write(folder)
    tiny(1).save(folder / POLICY)
    return folder


def test_a_training_is_packed_and_loaded(training: Path, tmp_path: Path) -> None:
    out = tmp_path / "packed"
    (card,) = pack(training.parent, out, "ugat-marl paper main")
    assert card.id == "single-v1/direct-transfer-s3"
    assert list(shipped_policies(out)) == [card.id]
    assert policy_card(card.id, folder=out) == card
    assert card.scores["V4"].att_s == 102 and card.scores["V4"].episodes == 2
    assert card.scores["V4"].low_s == pytest.approx(102 - 12.706 * 2, abs=0.01)
    assert card.real is None and card.episodes == 2 and card.training_seed == 3
    scenario = load_scenario("single-v1")
    for domain, text in card.scenario_hashes.items():
        assert text == scenario_in_domain(scenario, domain).hash
    loaded, own = load_policy(card.id, folder=out), NetworkPolicy.load(training / POLICY)
    assert np.array_equal(loaded.parameters, own.parameters)


def test_a_packed_policy_that_was_changed_is_refused(training: Path, tmp_path: Path) -> None:
    out = tmp_path / "packed"
    (card,) = pack(training, out)
    tiny(2).save(out / f"{card.id}.pt")
    with pytest.raises(CheckpointError, match="hashes differ"):
        load_policy(card.id, folder=out)
    file = out / f"{card.id}.json"
    content = json.loads(file.read_text())
    for key, value, said in (("scores", 3, "scores"), ("version", 9, "version 9")):
        file.write_text(json.dumps({**content, key: value}))
        with pytest.raises(CheckpointError, match=said):
            load_policy(card.id, folder=out)


def test_a_row_in_which_one_training_kept_a_rule_is_packed_in_no_part(
    training: Path, tmp_path: Path
) -> None:
    job = replace(Job.read(training), seed=4)
    other = training.parent / job.name
    shutil.copytree(training, other)
    job.write(other)
    NamedRule("largest-queue:20", ugat_marl.parallel_env("single-v1")).save(other / POLICY)
    said: list[str] = []
    reporter = Silent()
    reporter.say = said.append
    with pytest.raises(OptionError, match="no finished training"):
        pack(training.parent, tmp_path / "packed", reporter=reporter)
    assert "single-v1/direct-transfer is left out" in said[0]
    assert [card.training_seed for card in pack(training, tmp_path / "packed")] == [3]


def test_two_trainings_of_one_name_are_packed_neither(training: Path, tmp_path: Path) -> None:
    both = tmp_path / "both"
    for name in ("one", "other"):
        shutil.copytree(training, both / name / training.name)
    with pytest.raises(OptionError, match="two trainings of"):
        pack(both, tmp_path / "packed")
    assert not (tmp_path / "packed").exists()


def test_a_packed_policy_is_not_lost_to_another_training(training: Path, tmp_path: Path) -> None:
    out = tmp_path / "packed"
    (card,) = pack(training, out)
    pack(training, out)  # the same once more
    packed = (out / f"{card.id}.pt").read_bytes()
    tiny(2).save(training / POLICY)
    with pytest.raises(OptionError, match=r"s3\.pt: is the policy of another training"):
        pack(training, out)
    assert (out / f"{card.id}.pt").read_bytes() == packed


def test_a_training_of_another_version_is_not_packed(training: Path, tmp_path: Path) -> None:
    older = training.with_name(f"{training.name[:-10]}0123456789")
    training.rename(older)
    with pytest.raises(OptionError, match="trained with another version"):
        pack(older, tmp_path / "packed")


def test_what_is_not_finished_is_not_packed(training: Path, tmp_path: Path) -> None:
    record = JobRecord.read(training)
    record.scores.popitem()
    record.write(training)
    with pytest.raises(OptionError, match="no finished training"):
        pack(training, tmp_path / "packed")
    assert not (tmp_path / "packed").exists()


def test_unknown_policies_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UnknownNameError, match="file of a trained policy"):
        ugat_marl.load_policy("single-v1/no-such")
    assert main(["evaluate", "single-v1", "--policies", "single-v1/no-such"]) == 2
    assert "unknown policy 'single-v1/no-such'" in capsys.readouterr().err
    assert main(["policy", "card", "policies/some.pt"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "unknown shipped policy" in said and "works as well" not in said
    assert main(["policy", "pack", str(tmp_path), "--out", str(tmp_path / "packed")]) == 2
    assert "no finished training" in capsys.readouterr().err
    nowhere = str(tmp_path / "nowhere")
    assert main(["policy", "pack", nowhere, "--out", str(tmp_path / "packed")]) == 2
    assert "nowhere: no such folder" in capsys.readouterr().err
    assert not (tmp_path / "packed").exists()


def test_policies_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["policy", "list"]) == 0
    said = capsys.readouterr().out
    assert all(name.partition("/")[2][:8] in said for name in shipped_policies())


def test_shipped_policies_are_small() -> None:
    files = [path for path in FOLDER.rglob("*") if path.is_file()] if FOLDER.exists() else []
    assert sum(path.stat().st_size for path in files) < MOST_BYTES
    assert {path.suffix for path in files} <= {".pt", ".json"}


@pytest.mark.parametrize("name", shipped_policies())
def test_a_shipped_policy_fits_its_scenario_and_its_card(name: str) -> None:
    card = policy_card(name)
    assert PolicyCard.read(shipped_policies()[name].with_suffix(".json")) == card
    assert card.id == name and card.command.startswith("ugat-marl ")
    scenario = load_scenario(card.scenario)
    for domain, text in card.scenario_hashes.items():
        assert text == scenario_in_domain(scenario, domain).hash, domain
    policy = ugat_marl.load_policy(name)
    env = ugat_marl.parallel_env(scenario, **policy.env_options)
    assert AgentSet.of(env) == policy.agents
    assert set(card.scores) >= {"sim"} and all(own.episodes > 1 for own in card.scores.values())
