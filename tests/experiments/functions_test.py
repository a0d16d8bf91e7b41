"""The functions of scripts: names of policies, folders of runs, tables of evaluations."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import polars as pl
import pytest

import ugat_marl
from tests.runs import search_few_rules
from ugat_marl.data import Scores
from ugat_marl.effects import Headway
from ugat_marl.errors import CheckpointError, OptionError, UnknownNameError
from ugat_marl.experiments import (
    Evaluation,
    PaperConfig,
    TransferConfig,
    compare,
    paper,
    run_folder,
)
from ugat_marl.experiments.functions import _texts
from ugat_marl.experiments.scores import Result as Episode
from ugat_marl.grounding import (
    FitConfig,
    GateConfig,
    InputsConfig,
    ResidualConfig,
    StreetConfig,
    TimedConfig,
    UgatConfig,
    as_published,
    refuse_unused,
)
from ugat_marl.policies import DQNConfig, learner_factory
from ugat_marl.progress import Silent
from ugat_marl.testing import ToyTraffic

RESIDUAL = StreetConfig(residual=ResidualConfig("phase"))


def scored(att_s: float) -> Scores:
    return Scores(att_s, 2, 3, 4, 5, 6, 7, 8, 9, 10)


class Configured:
    """A learner that keeps its settings, of which one has a type."""

    def __init__(self, rate: Any, sizes: Any, hidden: Any, names: Any, tag: str) -> None:
        self.settings = {"rate": rate, "sizes": sizes, "hidden": hidden, "names": names, "tag": tag}

    def learn(self, env: Any, episodes: int) -> None: ...

    def policy(self) -> Any: ...


TABLE = Evaluation(
    "two",
    "",
    (
        Episode("a", "sim", 1, scored(10)),
        Episode("a", "sim", 2, scored(20)),
        Episode("a", "V4", 1, scored(30)),
        Episode("a", "V4", 2, scored(60)),
        Episode("b", "sim", 1, scored(12)),
        Episode("b", "sim", 2, scored(12)),
        Episode("b", "V4", 1, scored(40)),
        Episode("b", "V4", 2, scored(40)),
    ),
    {},
)


def test_the_frame_of_an_evaluation_has_gaps_and_regrets() -> None:
    frame = TABLE.frame()
    rows = {(row["policy"], row["domain"]): row for row in frame.to_dicts()}
    assert rows["a", "sim"]["att_s"] == 15 and rows["a", "sim"]["gap_s"] == 0
    assert rows["a", "V4"]["gap_s"] == 30 and rows["b", "V4"]["gap_s"] == 28
    assert rows["a", "V4"]["regret_s"] == 5 and rows["b", "V4"]["regret_s"] == 0
    assert rows["a", "sim"]["low_s"] < 15 < rows["a", "sim"]["high_s"]
    assert frame["episodes"].to_list() == [2] * 4
    each = TABLE.episodes_frame()
    assert each.height == 8 and each["att_s"].to_list()[:3] == [10, 20, 30]


@pytest.mark.parametrize(
    ("scenario", "real", "folder"),
    [
        ("single-v1", "V4", "single-v1-V4-s3"),
        ("/some/where/town.sumocfg", "reach=100+rain=1", "town-reach=100+rain=1-s3"),
        ("resco:cologne3", "found/corrected", "resco-cologne3-corrected-s3"),
    ],
)  # fmt: skip
def test_a_run_has_a_folder_of_its_own(scenario: str, real: str, folder: str) -> None:
    assert run_folder(TransferConfig(scenario, real=real, seed=3)) == Path("runs", folder)


def test_one_domain_may_be_a_text() -> None:
    one = np.int64(1)
    frame = ugat_marl.evaluate("single-v1", "random", "V1", seeds=one, duration_s=100, workers=1)
    assert frame["domain"].to_list() == ["V1"]
    frame = ugat_marl.evaluate(
        "single-v1", "random", [Headway(1.4)], seeds=[1], duration_s=100, workers=1
    )
    assert frame["domain"].to_list() == ["headway=1.4"]


@pytest.mark.parametrize(
    ("config", "says"),
    [
        (
            UgatConfig("phase", timed=TimedConfig(most_s=3)),
            "timed.most_s = 3 counts with the grounding timed",
        ),
        (
            UgatConfig("phase", street=StreetConfig(simulations=40)),
            "street.simulations = 40 counts with the grounding street;",
        ),
        (
            UgatConfig("street", fit=FitConfig(epochs=3)),
            "fit.epochs = 3 counts .*phase or timed, or",
        ),
        (UgatConfig("street", inputs=InputsConfig(history=2)), "inputs.history = 2 counts"),
        (UgatConfig("street", sim_rollouts=5), "sim_rollouts = 5 counts .* phase or timed;"),
        (UgatConfig("street", least_accuracy=0.5), "least_accuracy = 0.5 counts"),
        (UgatConfig("timed", timed=TimedConfig(most_s=3), gate=GateConfig("static")), None),
        (UgatConfig("street", street=RESIDUAL, fit=FitConfig(epochs=3), least_accuracy=0.5), None),
        (as_published(UgatConfig()), None),
    ],
)
def test_settings_of_another_grounding_are_refused(config: UgatConfig, says: str | None) -> None:
    if says is None:
        refuse_unused(config, config.used)
    else:
        with pytest.raises(OptionError, match=says):
            refuse_unused(config, config.used)


def test_a_table_refuses_settings_that_none_of_its_rows_uses(tmp_path: Path) -> None:
    """An older run that has some can be resumed, so they make a configuration."""
    config = PaperConfig(rows=("fitted street",), fit=FitConfig(epochs=3))
    with pytest.raises(OptionError, match="fit.epochs = 3 counts with the grounding phase"):
        compare("main", "single-v1", config, tmp_path, 1, Silent())


@pytest.mark.parametrize(("table", "rows"), [("gap", ()), ("main", ("direct transfer",))])
def test_what_a_preset_sets_is_not_refused_without_grounded_rows(
    table: str, rows: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(paper, "perform_all", Mock(side_effect=InterruptedError))
    config = PaperConfig(preset="paper", domains=("V4",), rows=rows)
    with pytest.raises(InterruptedError):
        compare(table, "single-v1", config, tmp_path, 1, Silent())


def test_wrong_calls_are_refused() -> None:
    for policies in (["random", "random"], [], {}):
        with pytest.raises(OptionError, match="policies"):
            ugat_marl.evaluate("single-v1", policies, ["sim"])
    with pytest.raises(OptionError, match="settings dqn are of the learners dqn and universal"):
        ugat_marl.train("single-v1", learner="ippo", dqn=DQNConfig(batch_size=8))
    with pytest.raises(OptionError, match="at least one"):
        ugat_marl.evaluate("single-v1", ["random"], [])
    wrong: list[Any] = [1.5, [1.7], True, [-1], "12"]
    for seeds in wrong:
        with pytest.raises(OptionError, match="give a number of episodes, or a list of seeds"):
            ugat_marl.evaluate("single-v1", ["random"], ["sim"], seeds=seeds)
    mixed: list[Any] = ["sim", Headway(1.4)]
    with pytest.raises(OptionError, match="mixes domains and single effects"):
        ugat_marl.evaluate("single-v1", ["random"], mixed)
    loaded: Any = ugat_marl.load_scenario("single-v1")
    with pytest.raises(OptionError, match=r"name or the path .* scenario.write\(folder\)"):
        ugat_marl.train(loaded)
    preset: Any
    for preset in ("papr", ""):
        with pytest.raises(UnknownNameError, match="unknown preset"):
            ugat_marl.train("single-v1", preset=preset)
        with pytest.raises(UnknownNameError, match="unknown preset"):
            PaperConfig(preset=preset)
    with pytest.raises(UnknownNameError, match="largest-queue"):
        ugat_marl.evaluate("single-v1", "largst-queue", ["sim"])
    with pytest.raises(UnknownNameError, match="universal"):
        ugat_marl.train("single-v1", learner="univrsal")


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"seed": "1"}, "seed = '1': must be a whole number"),
        ({"seed": None}, "seed = None"),
        ({"reward": len}, "reward = .*: train takes the name of one"),
        ({"observation": len}, "observation = .*: train takes the name of one"),
        ({"callback": 5}, "callback = 5"),
        ({"real": ["V3", "V4"]}, r"real = \['V3', 'V4'\]: train takes one domain"),
        ({"sim": ["V4"]}, "sim = .*one domain"),
        ({"control": "no"}, "control = 'no': train does not take a str"),
        ({"dqn": {"hidden": 3}}, "dqn = .*: train does not take a dict"),
        ({"evaluation_seeds": 3.0}, "evaluation_seeds = 3.0: must be a whole number"),
        ({"real": None}, 'real = "none" needs real_log'),
        ({"workers": "2"}, "workers = '2': must be a whole number"),
        ({"workers": 1.5}, "workers = 1.5"),
    ],
)
def test_wrong_arguments_of_a_training_leave_no_folder(
    wrong: dict[str, Any], says: str, tmp_path: Path
) -> None:
    with pytest.raises(OptionError, match=says):
        ugat_marl.train("single-v1", duration_s=60, out=tmp_path / "run", **wrong)
    assert not (tmp_path / "run" / "settings.json").exists()


def test_numbers_of_numpy_are_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    search_few_rules(monkeypatch, "programme")
    one: Any = np.int64(1)
    run = ugat_marl.train(
        "single-v1", grounding="phase", pretrain_episodes=one, iterations=np.int64(0), seed=one,  # type: ignore[arg-type]
        duration_s=np.float64(100), evaluation_seeds=one, control=np.bool_(False), workers=one,  # type: ignore[arg-type]
        ugat=None, dqn=DQNConfig(batch_size=np.int64(8)), out=tmp_path / "run",  # type: ignore[arg-type]
    )  # fmt: skip
    written = json.loads((run.folder / "settings.json").read_text())
    asked = written["settings"]
    assert (asked["seed"], asked["duration_s"], asked["control"]) == (1, 100.0, False)
    assert (asked["ugat"]["pretrain_episodes"], asked["dqn"]["batch_size"]) == (1, 8)
    assert run.table["low_s"].null_count() == run.table.height  # of one episode nothing is known
    with pytest.raises(CheckpointError, match=r"its ugat\.pretrain_episodes is 1, asked for is 2;"):
        ugat_marl.train(
            "single-v1", grounding="phase", pretrain_episodes=2, iterations=0, seed=1,
            duration_s=100.0, evaluation_seeds=1, control=False, workers=1,
            dqn=DQNConfig(batch_size=8), resume=True, out=tmp_path / "run",
        )  # fmt: skip


def test_settings_may_be_a_dictionary() -> None:
    given = {"rate": 0.1, "sizes": (8, 16), "hidden": (32,), "names": [], "tag": "12"}
    texts = ("rate=0.1", "sizes=8,16", "hidden=(32,)", "names=[]", "tag=12")
    assert _texts(f"{__name__}:Configured", given) == texts
    made = learner_factory(f"{__name__}:Configured", texts)
    assert made(ToyTraffic(), 0)._given.settings == given
    assert _texts("mine", "rate=0.1") == _texts("mine", ["rate=0.1"]) == ("rate=0.1",)


def test_what_the_package_offers_is_listed() -> None:
    offered = {"train", "evaluate", "parallel_env", "env", "vector_env", "load_scenario"}
    assert offered <= set(dir(ugat_marl))
    for name in dir(ugat_marl):
        assert getattr(ugat_marl, name).__doc__


class Stopped(Exception):
    """Raised by a callback, as a search does that prunes a trial."""


def test_a_callback_gets_what_is_logged_and_may_end_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    search_few_rules(monkeypatch, "largest-queue:20", "programme")
    options: dict[str, Any] = {
        "learner": "ippo", "grounding": "phase", "pretrain_episodes": 2, "iterations": 1,
        "grounded_episodes": 1, "real_rollouts": 1, "evaluation_seeds": 1, "duration_s": 100,
        "control": False, "workers": 1, "out": tmp_path / "run",
    }  # fmt: skip
    heard: list[tuple[str, int, dict[str, float]]] = []

    def hear(stage: str, step: int, numbers: Mapping[str, float]) -> None:
        if stage == "iteration" and step > 0 and not any(kind == "stop" for kind, *_ in heard):
            heard.append(("stop", step, {}))
            raise Stopped
        heard.append((stage, step, dict(numbers)))

    with pytest.raises(Stopped):
        ugat_marl.train("single-v1", real="V4", callback=hear, **options)
    run = ugat_marl.train("single-v1", real="V4", callback=hear, resume=True, **options)
    assert {stage for stage, *_ in heard} == {"episode", "iteration", "evaluation", "stop"}
    # the episode after the last checkpoint is played, and told, twice
    assert [step for stage, step, _ in heard if stage == "episode"] == [0, 1, 2, 2]
    logged = {
        (row["stage"], row["step"], row["name"]): row["value"]
        for row in pl.read_parquet(run.folder / "metrics.parquet").to_dicts()
    }
    told = {
        (stage, step, name): value
        for stage, step, numbers in heard
        if stage not in ("evaluation", "stop")
        for name, value in numbers.items()
    }
    assert told == pytest.approx(logged, nan_ok=True)
    stage, step, table = heard[-1]
    assert (stage, step) == ("evaluation", 3)
    for row in run.table.to_dicts():
        assert table[f"{row['policy']}/{row['domain']}/att_s"] == row["att_s"]


def test_settings_beside_those_that_hold_them_are_refused(tmp_path: Path) -> None:
    usual = int(UgatConfig.iterations)
    for iterations in (7, usual):
        with pytest.raises(OptionError, match="give grounding, pretrain_episodes"):
            ugat_marl.train(
                "single-v1", iterations=iterations, ugat=UgatConfig(), out=tmp_path / "run"
            )
    assert not (tmp_path / "run").exists()


def test_policies_may_come_in_any_collection() -> None:
    rules = {"programme": 1, "fixed-time:30": 2}
    for several in (rules.keys(), (name for name in rules)):
        frame = ugat_marl.evaluate("single-v1", several, "sim", seeds=1, duration_s=60, workers=1)
        assert frame["policy"].to_list() == ["programme", "fixed-time:30"]
