"""The preset "paper": Algorithm 1 as published, and nothing else beside it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from tyro.conf import CascadeSubcommandArgs

import ugat_marl
from ugat_marl.__main__ import main
from ugat_marl.errors import OptionError
from ugat_marl.experiments import PaperConfig, TransferConfig
from ugat_marl.experiments.paper import settings_of
from ugat_marl.grounding import GateConfig, UgatConfig, as_published
from ugat_marl.progress import Silent


def test_the_preset_restores_every_departure_and_keeps_numbers_of_episodes() -> None:
    config = TransferConfig("single-v1", preset="paper", ugat=UgatConfig(grounded_episodes=7))
    ugat = config.ugat
    assert ugat.grounding == "phase"
    assert ugat.grounded_episodes == ugat.gate.window_epochs == 7
    assert (ugat.rollout_epsilon, ugat.least_accuracy) == (0.0, None)
    assert ugat.forward.include_phase and ugat.inverse.include_phase
    assert (ugat.fit.kl_weight, ugat.fit.off_data_weight, ugat.fit.epochs) == (1.0, 0.0, 300)
    assert ugat.gate.scope == "pooled"
    assert replace(config, seed=3).ugat == ugat  # applied twice it changes nothing
    assert as_published(ugat) == ugat


COUNTS = (
    "pretrain_episodes",
    "iterations",
    "grounded_episodes",
    "sim_rollouts",
    "real_rollouts",
)


def command(config: type[Any], *words: str) -> Any:
    import tyro

    return tyro.cli(config, args=["--preset", "paper", *words], config=(CascadeSubcommandArgs,))


@pytest.mark.parametrize("name", COUNTS)
def test_a_number_that_is_given_stays_though_it_is_the_usual_one(name: str) -> None:
    usual = int(getattr(UgatConfig, name))
    free = TransferConfig("single-v1", preset="paper").ugat
    assert (usual != getattr(free, name)) is (name not in ("grounded_episodes", "sim_rollouts"))
    option = f"--{name.replace('_', '-')}"
    for config in (
        TransferConfig("single-v1", preset="paper", ugat=UgatConfig(**{name: usual})),
        command(TransferConfig, "single-v1", option, str(usual)),
    ):
        assert getattr(config.ugat, name) == usual
        others = [x for x in COUNTS if x != name]
        assert [getattr(config.ugat, x) for x in others] == [getattr(free, x) for x in others]
        assert replace(config, seed=3).ugat == config.ugat
    row = "episodes" if name == "pretrain_episodes" else name
    paper = command(PaperConfig, f"--{row.replace('_', '-')}", str(usual))
    assert getattr(paper, row) == getattr(paper.ugat, name) == usual


def test_a_learner_that_is_given_stays() -> None:
    assert PaperConfig().learner == PaperConfig(preset="paper", learner="universal").learner
    assert PaperConfig(preset="paper").learner == "dqn"


def test_what_the_preset_decides_cannot_be_given_beside_it() -> None:
    with pytest.raises(OptionError, match="decides all settings"):
        TransferConfig("single-v1", preset="paper", ugat=UgatConfig(grounding="timed"))
    with pytest.raises(OptionError, match="decides all settings"):
        TransferConfig(
            "single-v1", preset="paper", ugat=UgatConfig(gate=GateConfig(mode="infinite"))
        )


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--rollout-epsilon", "0.3"], "rollout_epsilon = 0.0, not 0.3"),
        (["--least-accuracy", "0"], "least_accuracy = None, not 0.0"),
        (["--fit.epochs", "100"], "fit.epochs = 300, not 100"),
        (["--grounding", "timed"], "grounding = phase, not timed"),
        (["--grounding", "street"], "grounding = phase, not street"),
        (["--gate.scope", "intersection"], "gate.scope = pooled, not intersection"),
    ],
)
def test_a_usual_value_that_is_given_beside_the_preset_is_not_replaced_without_a_word(
    words: list[str], told: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        command(TransferConfig, "single-v1", *words)
    assert told in str(ended.value.__context__)


def test_the_page_gives_what_the_preset_stands_for() -> None:
    import tyro

    page = (Path(__file__).parents[2] / "docs" / "tutorials" / "student.md").read_text()
    (words,) = [
        block.replace("\\\n", " ").split()
        for block in re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
        if "--gate.static-alpha" in block
    ]
    given = tyro.cli(TransferConfig, args=words[2 : words.index("--out")])
    plain = replace(given.ugat, gate=replace(given.ugat.gate, mode="dynamic", static_alpha=0.5))
    counts = {name: int(getattr(plain, name)) for name in COUNTS}
    published = as_published(UgatConfig(**counts))
    assert replace(plain, gate=replace(plain.gate, window_epochs=published.gate.window_epochs)) == (
        published
    )
    paper = TransferConfig("single-v1", preset="paper")
    assert (given.learner, given.reward) == (paper.learner, paper.reward)


@pytest.mark.parametrize("alpha", ["0.3", "0.5"])
@pytest.mark.parametrize("command", [["train", "single-v1"], ["paper", "main"]])
def test_a_threshold_counts_in_its_own_mode_alone(
    command: list[str],
    alpha: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("ugat_marl.experiments.paper.perform_all", None)
    words = [*command, "--gate.static-alpha", alpha, "--out", str(tmp_path / "run")]
    assert main(words) == 2
    assert f"--gate.static-alpha {alpha} counts with --gate.mode static" in capsys.readouterr().err
    assert GateConfig(mode="infinite", static_alpha=0.3).static_alpha == 0.3


@pytest.mark.parametrize("mode", ["static", "infinite"])
@pytest.mark.parametrize("epochs", ["4", "20"])
@pytest.mark.parametrize("command", [["train", "single-v1"], ["paper", "main"]])
def test_a_window_counts_with_a_dynamic_alpha_alone(
    command: list[str],
    epochs: str,
    mode: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("ugat_marl.experiments.paper.perform_all", None)
    words = ["--gate.mode", mode, "--gate.window-epochs", epochs, "--out", str(tmp_path / "run")]
    assert main([*command, *words]) == 2
    told = f"--gate.window-epochs {epochs} counts with --gate.mode dynamic alone, not {mode}"
    assert told in capsys.readouterr().err
    gate = GateConfig(mode=mode, window_epochs=int(epochs))
    gate.require_settings_count(also_dynamic=True)  # as the table "alpha" trains
    GateConfig(mode=mode).require_settings_count()
    GateConfig(window_epochs=int(epochs)).require_settings_count()


@pytest.mark.parametrize("preset", [None, "paper"])
def test_a_plan_is_made_from_the_defaults(preset: Any, tmp_path: Path) -> None:
    class Begun(Exception):
        """The first episode was played."""

    def stop(*_: object) -> None:
        raise Begun

    with pytest.raises(Begun):
        ugat_marl.train(
            "single-v1",
            preset=preset,
            pretrain_episodes=1,
            iterations=1,
            grounded_episodes=1,
            duration_s=60.0,
            out=tmp_path / "run",
            workers=1,
            reporter=Silent(),
            callback=stop,
        )


def test_the_preset_is_paid_by_the_queue_at_the_light() -> None:
    assert TransferConfig("single-v1").reward == "total-queue"
    assert TransferConfig("single-v1", preset="paper").reward == "queue"
    assert TransferConfig("single-v1", preset="paper", reward="queue").reward == "queue"
    with pytest.raises(OptionError, match="'queue', not 'total-queue'"):
        TransferConfig("single-v1", preset="paper", reward="total-queue")
    with pytest.raises(SystemExit):
        command(TransferConfig, "single-v1", "--reward", "total-queue")
    with pytest.raises(OptionError, match="not 'pressure'"):
        TransferConfig("single-v1", preset="paper", reward="pressure")


def test_the_tables_have_the_preset_too() -> None:
    config = PaperConfig(preset="paper", episodes=7, grounded_episodes=4)
    same = TransferConfig(
        "single-v1",
        preset="paper",
        ugat=UgatConfig(
            pretrain_episodes=7,
            iterations=config.iterations,
            grounded_episodes=4,
            sim_rollouts=config.sim_rollouts,
            real_rollouts=config.real_rollouts,
        ),
    )
    assert (config.ugat, config.reward, config.learner) == (same.ugat, "queue", same.learner)
    assert config.episodes == config.ugat.pretrain_episodes == 7
    assert config.all_episodes == 7 + 4 * config.ugat.iterations
    rows = settings_of("main", config.ugat, "sim", config.groundings, learner=config.spec)
    assert [row.ugat for row in rows if row.ugat is not None] == [config.ugat]
    assert replace(config, seeds=2).ugat == config.ugat  # applied twice it changes nothing
    for wrong in (
        {"groundings": ("timed",)},
        {"reward": "pressure"},
        {"gate": GateConfig("static")},
    ):
        with pytest.raises(OptionError, match="preset"):
            PaperConfig(preset="paper", **wrong)
