"""The tables of the paper: which trainings they need, which they share, and how they are run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from tests.runs import perform_in_this_process
from ugat_marl.__main__ import main
from ugat_marl.data import Scores
from ugat_marl.effects import load_scenario
from ugat_marl.errors import OptionError, UnknownNameError
from ugat_marl.experiments import (
    DIRECT,
    QUEUES,
    TIMED,
    PaperConfig,
    TransferConfig,
    compare,
    paper,
    read_queues,
)
from ugat_marl.experiments.driver import record_of
from ugat_marl.experiments.jobs import SCORES, JobRecord
from ugat_marl.experiments.paper import TABLES, Planner, settings_of
from ugat_marl.experiments.row_names import PHASE
from ugat_marl.experiments.settings import LearnerSpec, Setting
from ugat_marl.experiments.transfers import planned_jobs
from ugat_marl.grounding import (
    FitConfig,
    GateConfig,
    InputsConfig,
    StreetConfig,
    TimedConfig,
    UgatConfig,
)
from ugat_marl.progress import Silent

SHORT = PaperConfig(episodes=10, iterations=2, grounded_episodes=5, real_rollouts=3, seeds=2)


def planner(config: PaperConfig = SHORT, table: str = "main") -> Planner:
    return Planner(table, "single-v1", config)


def row(name: str, config: PaperConfig = SHORT, table: str = "main") -> Setting:
    (found,) = [setting for setting in config.settings(table) if setting.name == name]
    return found


def test_main_has_the_controls_an_honest_table_needs() -> None:
    names = [setting.name for setting in SHORT.settings("main")]
    assert names == [
        "direct transfer", "phase (the paper's UGAT)", "timed", "fitted street",
        "timed: rewards matched",
        "more plain sim",
        "domain randomisation", "random delay", "penalty on changes",
        *(f"constant delay {s} s" for s in (1, 2, 3, 4, 5, 6)),
        "fine-tuned on the same data", "trained in real", "best rule, tuned there",
    ]  # fmt: skip


def test_rewards_are_matched_in_the_row_that_says_so_alone() -> None:
    matching = {
        setting.name for table in TABLES for setting in SHORT.settings(table) if setting.matches
    }
    assert matching == {"timed: rewards matched"}


def test_rows_share_what_is_given_and_keep_what_they_are_named_for() -> None:
    config = replace(
        SHORT, inputs=InputsConfig(hops=1), gate=GateConfig(window_epochs=3),
        fit=FitConfig(uncertainty="dropout"),
    )  # fmt: skip
    rows = config.settings("ablation")
    grounded = {row.name: row.ugat for row in rows if row.ugat is not None}
    assert all(own.inputs.hops == 1 for own in grounded.values())
    assert all(own.gate.window_epochs == 3 for own in grounded.values())
    named = {name: own.fit.uncertainty for name, own in grounded.items()}
    assert {named.pop(f"{name}: no uncertainty (GAT)") for name in ("phase", TIMED)} == {"none"}
    assert set(named.values()) == {"dropout"}
    pairs = {name for name, own in grounded.items() if own.fit.pairs == "smoothed"}
    assert pairs == {"phase: h on smoothed pairs"}
    without = {name for name, own in grounded.items() if own.timed.answer == "constant"}
    assert without == {f"{TIMED}: lost times without h"}


def test_the_ablation_of_a_street_has_its_parts_and_its_residuals() -> None:
    config = replace(SHORT, groundings=("street",))
    rows = {s.name: s.ugat.street for s in config.settings("ablation") if s.ugat is not None}
    assert [name.partition(": ")[2] for name in rows] == [
        "", "channel alone", "eyes alone", "service alone", "effects alone",
        "all parts and residual, phase", "all parts and residual, timed",
    ]  # fmt: skip
    kinds = [street.residual.kind for street in rows.values()]
    assert kinds == ["none"] * 5 + ["phase", "timed"]
    assert all(len(street.parts) == 4 for street in list(rows.values())[5:])
    two = replace(config, street=StreetConfig(parts=("eyes", "service")))
    names = [s.name.partition(": ")[2] for s in two.settings("ablation") if s.ugat is not None]
    assert names[:3] == ["", "eyes alone", "service alone"]
    assert len(names) == 5


def test_the_ablation_has_a_row_for_each_departure_from_the_paper() -> None:
    rows = {s.name: s.ugat for s in SHORT.settings("ablation") if s.ugat is not None}
    for name in ("phase", TIMED):
        assert rows[f"{name}: own heads"].inverse.head == "own"
        of_h, after_f = (rows[f"{name}: several f, u of h{x}"] for x in ("", " after f"))
        assert of_h.forward == after_f.forward and of_h.forward.members > 1
        assert (of_h.gate.uncertainty_of, after_f.gate.uncertainty_of) == ("h", "h-after-f")
        assert rows[f"{name}: KL weight 1"].fit.kl_weight == 1.0
        assert rows[f"{name}: no off-data loss"].fit.off_data_weight == 0.0


def test_rewards_that_cannot_be_matched_have_no_such_row() -> None:
    names = [setting.name for setting in replace(SHORT, reward="pressure").settings("main")]
    assert "timed" in names and "timed: rewards matched" not in names


@pytest.mark.parametrize("table", ["main", "ablation", "alpha", "uncertainty"])
@pytest.mark.parametrize("preset", [None, "paper"])
def test_no_two_rows_of_a_table_are_one_training(table: str, preset: Any) -> None:
    """The preset pools α, and has no off-data loss and a KL weight of 1, as rows beside it do."""
    rows = PaperConfig(preset=preset).settings(table)
    identities = [json.dumps(row.identity, sort_keys=True) for row in rows]
    assert len(set(identities)) == len(identities)
    assert preset is None or table == "uncertainty" or PHASE in [row.name for row in rows]


@pytest.mark.parametrize(
    ("gate", "what"),
    [(GateConfig(mode="static", static_alpha=0.3), "α = 0.3"), (GateConfig("infinite"), "no gate")],
)
def test_a_row_whose_alpha_follows_no_uncertainty_is_named_by_it(
    gate: GateConfig, what: str
) -> None:
    for table in ("main", "ablation", "alpha"):
        settings = PaperConfig(gate=gate).settings(table)
        rows = {row.name: row.ugat for row in settings if row.ugat is not None}
        own = [rows[name] for name in (PHASE, TIMED) if name in rows]
        assert all(ugat.gate.mode == "dynamic" for ugat in own)
        assert len(own) == (2 if table == "alpha" else 0)
        named = {f"phase: {what}", f"timed: {what}"}
        assert named <= set(rows) or (table == "alpha" and gate.mode == "infinite")


@pytest.mark.parametrize("table", TABLES)
def test_rows_of_a_table_have_names_of_their_own_and_begin_with_direct_transfer(table: str) -> None:
    names = [setting.name for setting in SHORT.settings(table)]
    assert len(set(names)) == len(names)
    assert names[0] == DIRECT


def test_rows_can_be_picked_and_keep_their_order() -> None:
    some = replace(SHORT, rows=("trained in real", "timed"))
    assert [x.name for x in some.settings("main")] == [DIRECT, TIMED, "trained in real"]
    with pytest.raises(UnknownNameError, match="trained in real"):
        replace(SHORT, rows=("traned in real",)).settings("main")


def test_what_does_not_know_the_domain_is_trained_once_for_all_of_them() -> None:
    def trained(name: str) -> int:
        return len({job.name for job in planner().jobs(row(name))})

    assert trained(DIRECT) == 2  # seeds
    assert trained("constant delay 3 s") == 2
    assert trained(TIMED) == 8  # and domains
    assert trained("best rule, tuned there") == 4  # a rule has no seed


def test_every_policy_has_as_many_episodes() -> None:
    def episodes(name: str) -> int:
        return planner().jobs(row(name))[0].episodes

    assert episodes(DIRECT) == 10
    assert episodes("more plain sim") == episodes("trained in real") == 20
    assert episodes("fine-tuned on the same data") == 10 + 2 * 3  # as many as UGAT saw


def test_a_job_with_the_usual_number_of_episodes_is_known_when_it_is_done(tmp_path: Path) -> None:
    """Scores in files are known by plain numbers, and defaults are none."""
    config = PaperConfig(seeds=1)
    jobs = [job for setting in config.settings("main") for job in planner(config).jobs(setting)]
    for job in {
        job.name: job for job in [*jobs, *planned_jobs(TransferConfig("single-v1"))]
    }.values():
        scores = {
            (mark, domain, seed): Scores(*range(10))
            for mark in job.marks
            for domain in job.domains
            for seed in job.evaluation_seeds
        }
        (tmp_path / job.name).mkdir()
        JobRecord(scores).write(tmp_path / job.name)
        assert record_of(job, tmp_path) is not None, job.name


def test_tables_share_trainings() -> None:
    main_names = {job.name for job in planner().jobs(row("phase (the paper's UGAT)"))}
    for table, name in (
        ("ablation", "phase (the paper's UGAT)"),
        ("alpha", "phase (the paper's UGAT)"),
        ("uncertainty", "phase: evidential"),
    ):
        one_domain = replace(SHORT, domains=("V1",))
        own = planner(one_domain, table).jobs(row(name, one_domain, table))
        assert {job.name for job in own} <= main_names


def test_what_decides_a_policy_decides_its_folder() -> None:
    (first, *_) = planner().jobs(row("phase (the paper's UGAT)"))
    other = UgatConfig(grounded_episodes=6)
    for change in (
        {"seed": 7},
        {"target": "V2"},
        {"options": {**first.options, "duration_s": 600.0}},
        {"setting": replace(first.setting, ugat=other)},
        {"setting": replace(first.setting, learner=LearnerSpec("ippo"))},
    ):
        assert replace(first, **change).name != first.name
    renamed = replace(first.setting, name="another name")
    for same in ({"evaluation_seeds": (1,)}, {"domains": ("V1",)}, {"setting": renamed}):
        assert replace(first, **same).name == first.name


def test_every_row_of_a_table_has_the_learner_that_is_asked_for() -> None:
    config = replace(SHORT, learner="ippo", learner_settings=("hidden=8",))
    for table in TABLES:
        for setting in config.settings(table):
            assert setting.learner == LearnerSpec("ippo", ("hidden=8",))
    with pytest.raises(UnknownNameError, match="sb3-pp"):
        replace(SHORT, learner="sb3-pp")


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"seeds": 0}, "seeds = 0"),
        ({"scenario": ()}, "scenario is empty"),
        ({"domains": ("V3", "rain")}, "listed twice"),
        ({"domains": ("sim",)}, "the simulation itself"),
        ({"grounded_episodes": 0}, "grounded_episodes = 0"),
        ({"timed": TimedConfig(match=True)}, "a row of its own"),
    ],
)
def test_impossible_tables_are_refused(wrong: dict[str, Any], says: str) -> None:
    with pytest.raises(OptionError, match=says):
        PaperConfig(**wrong)


def test_impossible_rows_are_refused() -> None:
    with pytest.raises(OptionError, match="delays are whole seconds"):
        settings_of("main", UgatConfig(), "sim", constants=(0, 2))
    with pytest.raises(OptionError, match="phase, timed, street"):
        settings_of("main", UgatConfig(), "sim", groundings=("fase",))


@pytest.mark.parametrize(
    ("table", "options", "says"),
    [
        ("main", {"sim": "meso", "groundings": ("street",)}, "queue model"),
        ("main", {"sim": "lost_commands=0.1", "groundings": ("street",)}, "changes commands"),
        ("main", {"observation": "pressure", "learner": "dqn"}, "shows no numbers of vehicles"),
        ("ablation", {"domains": ("min_green=15",)}, "in the decision that asks for it"),
        (
            "ablation",
            {"domains": ("min_green=15",), "groundings": ("street",)},
            "in the decision that asks for it",
        ),
    ],
)
def test_rows_that_cannot_be_trained_are_refused_before_all_others_are(
    table: str, options: dict[str, Any], says: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(paper, "perform_all", None)
    with pytest.raises(OptionError, match=says):
        compare(table, "single-v1", PaperConfig(**options), tmp_path, 1, Silent())


def test_tables_of_two_scenarios_do_not_share_a_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(paper, "perform_all", None)
    towns = [str(tmp_path / folder / "town") for folder in ("a", "b")]
    for town in towns:
        load_scenario("single-v1").write(Path(town))
    assert main(["paper", "gap", "--scenario", *towns, "--out", str(tmp_path / "out")]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "two have the name 'town'" in said and "another --out" in said


def test_trainings_of_a_table_are_kept_before_others_are_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def trained(*_: Any, **__: Any) -> None:
        raise OptionError("the trainings begin")

    monkeypatch.setattr("ugat_marl.cli.paper.compare", trained)
    file = tmp_path / "single-v1" / "gap" / "seeds.csv"
    file.parent.mkdir(parents=True)
    table = pl.DataFrame(
        {
            "setting": ["direct transfer", "best rule, tuned there"],
            "domain": "V4",
            "training_seed": [1, 1],
            "att_s": 80.0,
            "att_s_sim": 60.0,
            "throughput": 900.0,
        }
    )
    table.write_csv(file)
    call = ["paper", "gap", "--domains", "V4", "--out", str(tmp_path), "--seeds"]
    assert main([*call, "1"]) == 2
    assert "'direct transfer' in V4 with seed 1; give the same" in capsys.readouterr().err
    assert main([*call, "2"]) == 2
    assert "the trainings begin" in capsys.readouterr().err
    assert pl.read_csv(file).equals(table)


def test_greens_are_late_in_the_simulation_that_is_trained_in(tmp_path: Path) -> None:
    def worlds(sim: str) -> list[str | None]:
        rows = settings_of("main", UgatConfig(), sim, constants=(3,))
        return [row.world for row in rows if row.name == "constant delay 3 s"]

    assert worlds("sim") == ["late_green=*,3"]
    assert worlds("meso") == ["meso+late_green=*,3"]
    (tmp_path / "scenario.toml").touch()
    with pytest.raises(OptionError, match="--constants"):
        worlds(str(tmp_path))
    assert settings_of("main", UgatConfig(), str(tmp_path), constants=())
    with pytest.raises(OptionError, match="late greens of its own"):
        worlds("V1+late_green=A1,2")


def test_the_simulation_is_no_real_domain_of_its_own_table() -> None:
    assert PaperConfig(sim="V1").targets("main") == ["V2", "V3", "V4"]
    with pytest.raises(OptionError, match="is the simulation itself"):
        PaperConfig(sim="light-loads").targets("alpha")


@pytest.mark.parametrize(
    "learner", [pytest.param((), marks=pytest.mark.slow), ("--learner", "ippo")]
)
def test_a_table_from_the_command_line(
    learner: tuple[str, ...],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if learner:  # without one, its jobs have processes of their own
        perform_in_this_process(monkeypatch)
    call = [
        "paper", "gap", "--domains", "V4", "--episodes", "1", "--seeds", "1", "--duration-s", "120",
        "--evaluation-seeds", "2", "--rule-budget", "2", *learner,
        "--out", str(tmp_path / "results"), "--runs", str(tmp_path / "runs"),
    ]  # fmt: skip
    assert main(call) == 0
    said = capsys.readouterr().out
    assert "best rule, tuned there" in said
    tables = said.partition("table and pictures")[0]
    assert max(map(len, tables.splitlines())) <= 80
    folder = tmp_path / "results" / "single-v1" / "gap"
    assert {path.name for path in folder.iterdir()} == {
        "table.md", "table.csv", "seeds.csv", "row-hashes.json", "radar.png", "gaps.png",
    }  # fmt: skip
    judged = pl.read_csv(folder / "seeds.csv").select("scenario", "episodes", "duration_s")
    assert set(judged.rows()) == {("single-v1", 2, 120.0)}
    before = (folder / "table.csv").read_bytes()
    trained = sorted(path for path in (tmp_path / "runs").iterdir() if path.is_dir())
    assert all(set(read_queues(path / QUEUES)["domain"]) >= {"V4"} for path in trained)
    times = [path.joinpath(SCORES).stat().st_mtime_ns for path in trained]
    assert main(call) == 0  # nothing is trained again
    assert [path.joinpath(SCORES).stat().st_mtime_ns for path in trained] == times
    assert (folder / "table.csv").read_bytes() == before


def test_options_that_a_table_does_not_have_are_refused() -> None:
    with pytest.raises(OptionError, match="table 'alpha' has no constants"):
        PaperConfig(constants=(9,)).settings("alpha")
    with pytest.raises(OptionError, match="table 'gap' has no grounding"):
        PaperConfig(groundings=("timed",)).settings("gap")
    assert PaperConfig(groundings=("phase",)).settings("gap")
