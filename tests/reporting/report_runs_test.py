"""The page of trainings: whole, under way and broken ones, several at once, hostile names."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import polars as pl
import pytest
import tyro

from tests.reporting.pages import Page, assert_drawn, needs_browser, seen_in_browser
from tests.runs import search_few_rules
from ugat_marl.__main__ import main
from ugat_marl.cli.report import again, train_options
from ugat_marl.cli.train import Train
from ugat_marl.data import Metrics, Scores, write_settings
from ugat_marl.effects import load_scenario
from ugat_marl.errors import CheckpointError, OptionError
from ugat_marl.experiments import (
    Evaluation,
    Interval,
    Job,
    JobRecord,
    Setting,
    TransferConfig,
    means_by_step,
    means_by_stretch,
    transfer,
)
from ugat_marl.experiments.scores import Result
from ugat_marl.grounding import FitConfig, GateConfig, StreetConfig, UgatConfig
from ugat_marl.policies import DQNConfig
from ugat_marl.reporting import RunRecord, read_records, runs_page, style, write_pictures
from ugat_marl.reporting import formats as words
from ugat_marl.reporting.charts import radar_picture
from ugat_marl.reporting.figures import NamedFigure, shortened_apart
from ugat_marl.reporting.formats import command_block, commands_in
from ugat_marl.reporting.network_maps import minutes_picture, node_map
from ugat_marl.reporting.page import Page as MadePage
from ugat_marl.reporting.places import places_of
from ugat_marl.reporting.run_records import read_rows
from ugat_marl.scenarios import Network

RESULTS = Path(__file__).parents[2] / "results"
NASTY = "</style><script>alert(1)</script>\"'><img src=x onerror=alert(2)>&amp;$\\frac{x}"
ATT = {
    "direct transfer": ((100.0, 102.0), (150.0, 154.0)),
    "phase (the paper's UGAT)": ((99.0, 101.0), (130.0, 134.0)),
    "more plain sim": ((98.0, 99.0), (155.0, 160.0)),
    "rule largest-queue:40": ((120.0, 121.0), (125.0, 126.0)),
}
LIGHTS = ("A1", "A2", "B1", "B2")
AGENTS = tuple(f"signal_{n}" for n in range(4))
FILES = (
    "run.json", "settings.json", "table.json", "metrics.parquet", "queues.parquet",
    "trainings/ugat/checkpoint/state.json",
)  # fmt: skip


def scores(att: float) -> Scores:
    return Scores(att, att - 5, 5e4 / att, -att / 30, att / 30, 0.3, att - 60, 520.0, 515.0, 0.0)


def evaluation(shift: float = 0.0, real: str = "V4") -> Evaluation:
    results = tuple(
        Result(policy, domain, 1000 + seed, scores(att + shift))
        for policy, domains in ATT.items()
        for domain, values in zip(("sim", real), domains, strict=True)
        for seed, att in enumerate(values)
    )
    notes = {f"best rule in {real}": "largest-queue:40", "training seed": "0"}
    return Evaluation("grid2x2-v1", "h" * 64, results, notes)


def metrics(iterations: int = 2, episodes: int = 24, shift: float = 0.0) -> Metrics:
    found = Metrics()
    for episode in range(episodes):
        found.add("episode", episode, {"return": -4000.0 + 50 * episode + shift})
    found.add("iteration", 0, {"att_s/sim": 100.0, "att_s/V4": 152.0 + shift})
    for iteration in range(1, iterations + 1):
        numbers = {"att_s/sim": 100.0, "att_s/V4": 150.0 - 10 * iteration + shift}
        for name, mean in (("acceptance", 0.5), ("mean_u", 0.3), ("change_rate", 0.2)):
            numbers[f"gate/{name}"] = mean
            numbers |= {f"gate/{name}/{a}": mean + 0.1 * k for k, a in enumerate(AGENTS)}
        numbers |= {"gate/alpha": np.inf if iteration == 1 else 0.35}
        numbers |= {f"gate/alpha/{a}": numbers["gate/alpha"] for a in AGENTS}
        found.add("iteration", iteration, numbers)
    return found


def queues() -> pl.DataFrame:
    rows = [
        (policy, domain, 0, minute, tls, float(k + (minute if tls == "B2" else 0)) * factor, 6)
        for policy, factor in (("direct transfer", 2.0), ("phase (the paper's UGAT)", 1.0))
        for domain in ("sim", "V4")
        for minute in range(10)
        for k, tls in enumerate(LIGHTS)
    ]
    names = ["policy", "domain", "batch", "minute", "intersection", "queue", "looks"]
    return pl.DataFrame(rows, schema=names, orient="row")


def make_run(directory: Path, *, seed: int = 0, real: str = "V4", **changes: Any) -> Path:
    """A folder such as a run leaves; `changes` are of the configuration."""
    ugat = UgatConfig("phase", pretrain_episodes=14, iterations=2, grounded_episodes=5)
    config = TransferConfig("grid2x2-v1", real, seed=seed, ugat=ugat, **changes)
    directory.mkdir(parents=True)
    checkpoint = directory / "trainings" / "ugat" / "checkpoint"
    checkpoint.mkdir(parents=True)
    scenario = load_scenario("grid2x2-v1")
    if config.duration_s is not None:
        scenario = scenario.with_duration(config.duration_s)
    hashes = {"sim": scenario.hash, "real": "r" * 64}
    identity = {**config.as_dict(), "scenario_hash": hashes, "domains": ["sim", real]}
    (directory / "run.json").write_text(json.dumps(identity))
    write_settings(directory, config.as_dict())
    evaluation(3.0 * seed, real).write(directory / "table.json")
    metrics(shift=float(seed)).write(directory / "metrics.parquet")
    metrics(1).write(checkpoint / "metrics.parquet")
    queues().write_parquet(directory / "queues.parquet")
    state = {"pretrained": 14, "iteration": 2}
    (checkpoint / "state.json").write_text(json.dumps(state))
    return directory


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return make_run(tmp_path / "first")


@pytest.fixture
def quick_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are made, and not written into pages: their writing takes most of the time."""
    monkeypatch.setattr(NamedFigure, "for_page", lambda _: "<svg></svg>")


def page_of(*paths: Path) -> tuple[MadePage, Page]:
    records = read_records(paths)
    made = runs_page(records, {record.directory: again(record) for record in records})
    return made, Page(made.text)


# --- one training ---------------------------------------------------------------------------------


def test_a_whole_run_is_shown_with_the_numbers_of_its_records(run: Path) -> None:
    made, page = page_of(run)
    found = evaluation()
    row = page.row("phase (the paper's UGAT)")
    real = found.estimate("phase (the paper's UGAT)", "V4", "att_s")
    assert (
        row[2] == f"{words.number(real.mean)} (107 to 157)" and real.mean == 132
    )  # t of one degree of freedom: 12.7
    assert (
        row[3] == words.signed(found.gap("phase (the paper's UGAT)", "V4", "att_s").mean) == "+32"
    )
    assert row[4] == words.number(found.regret("phase (the paper's UGAT)", "V4").mean) == "6.5"
    assert page.row("direct transfer")[2].startswith("152 (127 to 177)")
    # (152 - 101) of gap before, (132 - 100) after
    assert words.share(1 - 32 / 51) in page.text
    for part in ("Travel time in V4: direct transfer 152 s, phase (the paper's UGAT) 132 s",
                 "whole", "grid2x2-v1", "rule largest-queue:40"):  # fmt: skip
        assert part in page.text
    assert "Missing here" not in page.text
    gate = page.row("signal_3")
    assert gate[:4] == ["signal_3", "B2", "80 %", "0.6"] and gate[4] == "0.35"
    worst = page.row("B2 (signal_3)")
    # B2 has 3 + minute vehicles under UGAT: 7.5 in the mean, 12 in the last minute
    assert worst == ["B2 (signal_3)", "7.5", "12", "minute 9", "15", "24", "minute 9"]
    names = [picture.name for picture in made.pictures]
    assert names == list(dict.fromkeys(names))
    assert {"first-radar-V4", "first-gate", "first-map-queue"} <= set(names)


def test_the_page_needs_nothing_else_and_every_picture_has_words(run: Path) -> None:
    made, page = page_of(run)
    text = made.text
    # A picture refers to its own parts, by their ids; nothing else is referred to.
    assert not re.findall(r'https?:|src=|url\((?!#)|@import|<script|<link|href="(?!#)', text)
    assert "default-src 'none'" in text
    pictures = [attrs for tag, attrs in page.tags if tag == "svg"]
    assert len(pictures) >= 8
    assert all(attrs["role"] == "img" and len(attrs["aria-label"]) > 5 for attrs in pictures)
    captions = sum(tag == "figcaption" for tag, _ in page.tags)
    assert captions == len(pictures) == sum(tag == "figure" for tag, _ in page.tags)


def test_a_run_under_way_shows_how_far_it_is(run: Path) -> None:
    for name in ("table.json", "queues.parquet"):
        (run / name).unlink()
    _, page = page_of(run)
    assert "not finished" in page.text
    assert (
        "So far: 14 of 14 episodes of plain training, 2 of 2 iterations. Last written" in page.text
    )
    assert "table.json is not there: the run is under way, or was stopped" in page.text
    assert "--resume" in page.text
    assert "Learning curves" in page.text and "The gate" in page.text


@pytest.mark.usefixtures("quick_pictures")
@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("how", ["gone", "empty", "half", "other"])
def test_what_is_broken_is_named(run: Path, name: str, how: str) -> None:
    path = run / name
    content = path.read_bytes()
    if how == "gone":
        path.unlink()
    else:
        broken = {"empty": b"", "half": content[: len(content) // 2], "other": b"[1, 2]"}
        path.write_bytes(broken[how])
    made, page = page_of(run)
    assert "Missing here" in page.text and name in page.text
    if name == "metrics.parquet":
        assert "trainings/ugat/checkpoint/metrics.parquet is shown instead" in page.text
        assert any(picture.name == "first-gate" for picture in made.pictures)


@pytest.mark.slow
@pytest.mark.usefixtures("quick_pictures")
def test_no_damage_is_a_traceback(run: Path, tmp_path: Path) -> None:
    """Every file cut at, and disturbed at, many places."""
    seen = set[str]()
    draw = np.random.default_rng(0)
    for name in FILES:
        path = run / name
        content = path.read_bytes()
        for _ in range(25):
            place = int(draw.integers(len(content)))
            if draw.random() < 0.5:
                path.write_bytes(content[:place])
            else:
                other = bytearray(content)
                other[place] = int(draw.integers(256))
                path.write_bytes(bytes(other))
            (record,) = read_records([run])
            assert isinstance(record, RunRecord)
            rows = record.metrics.rows if record.metrics is not None else None
            missing = re.sub(r"\(.*\)", "", str(record.missing))  # whatever the reason
            content_of_page = repr((missing, rows, record.evaluation, record.settings,
                                    record.hashes, record.versions, record.state,
                                    record.queues))  # fmt: skip
            if content_of_page not in seen:  # another record of the same is the same page
                seen.add(content_of_page)
                page_of(run)
        path.write_bytes(content)
    assert not list(tmp_path.glob("*.tmp"))


def test_a_file_that_makes_its_reader_panic_is_broken(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seen in one of a hundred files with a wrong byte; polars then raises a BaseException."""

    def panic(path: Path) -> None:
        raise pl.exceptions.PanicException("assertion failed")

    monkeypatch.setattr(pl, "read_parquet", panic)
    _, page = page_of(run)
    for name in ("metrics.parquet", "queues.parquet"):
        assert f"{name} cannot be used (cannot be read (assertion failed)" in page.text


def test_a_changed_digit_of_the_table_is_damage_with_its_row(run: Path) -> None:
    table = json.loads((run / "table.json").read_text())
    table["episodes"][7]["att_s"] += 8
    (run / "table.json").write_text(json.dumps(table))
    _, page = page_of(run)
    assert "damaged, row 7 of episodes is not what was written" in page.text


def test_values_of_a_wrong_kind_are_no_traceback(run: Path) -> None:
    table = json.loads((run / "table.json").read_text())
    del table["row_hashes"]  # else it is damaged
    for key, value in {"approaches": [1], "hidden": "x"}.items():
        rows = [{**row, key: value} for row in table["episodes"]]
        (run / "table.json").write_text(json.dumps(table | {"episodes": rows}))
        assert "table.json cannot be used" in page_of(run)[1].text
    table["episodes"][0]["att_s"] = None
    table["episodes"][9]["queue"] = None
    (run / "table.json").write_text(json.dumps(table))
    _, page = page_of(run)
    assert page.row("direct transfer")[1] == "–"
    for settings in ({"scenario": 3, "ugat": [], "seed": {}}, {"ugat": {"iterations": "x"}}, []):
        for name in ("settings.json", "run.json"):
            (run / name).write_text(json.dumps({"settings": settings}))
        page_of(run)
    metrics = Metrics([("iteration", 1, f"gate/acceptance/{a}", np.nan) for a in AGENTS])
    metrics.add("iteration", 1, {"gate/acceptance": np.nan, "att_s/sim": np.nan})
    metrics.add("episode", 0, {"return": np.nan})
    metrics.write(run / "metrics.parquet")
    page_of(run)


def test_what_only_an_objective_measures_is_shown_with_its_unit(run: Path) -> None:
    found = evaluation()
    results = tuple(
        replace(r, scores=replace(r.scores, hidden={"co2_g": 250.0})) if r.domain == "V4" else r
        for r in found.results
    )
    replace(found, results=results).write(run / "table.json")
    _, page = page_of(run)
    assert "CO2 [g/veh]" in page.text
    rows = [row for row in page.cells if row[:1] == ["phase (the paper's UGAT)"] and len(row) == 10]
    assert [row[-1] for row in rows] == ["–", "250"]


def test_an_episode_of_another_length_is_no_change_of_the_scenario(tmp_path: Path) -> None:
    run = make_run(tmp_path / "first", duration_s=600.0)
    assert "The scenario has changed since" not in page_of(run)[1].text


@pytest.mark.parametrize(
    "more",
    [{"target": "V4", "options": {"duration_s": 600.0}}, {"sim": "V1", "target": "sim"}],
)
def test_a_job_of_an_unchanged_scenario_has_no_remark(tmp_path: Path, more: Any) -> None:
    setting = Setting("timed", "grounded", ugat=UgatConfig(grounding="timed"))
    make_job(tmp_path, "timed-0", (), setting, **more)
    identity = Job.read(tmp_path / "timed-0").identity
    (tmp_path / "timed-0" / "run.json").write_text(json.dumps(identity))
    (record,) = read_records([tmp_path / "timed-0"])
    assert isinstance(record, RunRecord) and len(record.hashes) == 2
    assert places_of(record)[1] == ""
    (tmp_path / "timed-0" / "run.json").write_text("{bad")
    (record,) = read_records([tmp_path / "timed-0"])
    assert any(text.startswith("run.json cannot be used") for text in record.missing)


def test_a_scenario_that_is_gone_or_changed_is_said(run: Path) -> None:
    assert "The scenario has changed since" not in page_of(run)[1].text
    settings = json.loads((run / "settings.json").read_text())
    identity = json.loads((run / "run.json").read_text())
    identity["scenario_hash"]["sim"] = "0" * 64
    (run / "run.json").write_text(json.dumps(identity))
    assert "The scenario has changed since" in page_of(run)[1].text
    settings["settings"]["scenario"] = "/nowhere/at/all.sumocfg"
    (run / "settings.json").write_text(json.dumps(settings))
    assert "no map: scenario '/nowhere/at/all.sumocfg' cannot be read here" in page_of(run)[1].text


def test_hostile_names_stay_text(tmp_path: Path) -> None:
    harmless = make_run(tmp_path / "harmless")
    run = make_run(tmp_path / "<script>alert(3)<" / "script>")
    found = replace(evaluation(), scenario=NASTY, notes={NASTY: NASTY, "best rule in V4": NASTY})
    results = tuple(replace(r, policy=f"{NASTY}{r.policy}", domain=f"{NASTY}{r.domain}")
                    for r in found.results)  # fmt: skip
    replace(found, results=results).write(run / "table.json")
    names = [(f"{NASTY}{p}", f"{NASTY}{d}", batch, m, f"{NASTY}\x1b{t}", *means)
             for p, d, batch, m, t, *means in queues().rows()]  # fmt: skip
    pl.DataFrame(names, schema=queues().schema, orient="row").write_parquet(run / "queues.parquet")
    numbers = Metrics([(s, n, f"{k}{NASTY}\x07", v) for s, n, k, v in metrics().rows])
    late = [("iteration", 2, f"channel/late_s{end}/{agent}", 5.0)
            for end in ("", "_low", "_high") for agent in AGENTS]  # fmt: skip
    Metrics([*metrics().rows, *numbers.rows, *late]).write(run / "metrics.parquet")
    kept = json.loads((run / "settings.json").read_text())
    kept["settings"] |= {NASTY: "\ud800\x00", "real": NASTY}
    kept["versions"] |= {NASTY: NASTY}
    (run / "settings.json").write_text(json.dumps(kept))
    made, page = page_of(run)
    assert NASTY in " ".join(page.texts)
    _, plain = page_of(harmless)
    assert {tag for tag, _ in page.tags} <= {tag for tag, _ in plain.tags} | {"ul", "li"}
    assert not [name for _, attrs in page.tags for name in attrs if name.startswith("on")]
    made.text.encode()
    for picture in made.pictures:
        ET.fromstring(picture.svg())
        assert re.fullmatch(r"[\w=+.-]{1,80}", picture.name)
    assert any("map-channel-late_s" in picture.name for picture in made.pictures)
    write_pictures(made.pictures[:2], tmp_path / "pictures")


# --- several ------------------------------------------------------------------------------------


def test_seeds_are_put_together_with_intervals(tmp_path: Path) -> None:
    for seed in range(3):
        make_run(tmp_path / "runs" / f"s{seed}", seed=seed)
    made, page = page_of(tmp_path / "runs")
    interval = Interval.of(np.array([132.0, 135.0, 138.0]))
    row = next(
        row for row in page.cells if row[:1] == ["phase (the paper's UGAT)"] and len(row) == 2
    )
    assert row[1] == f"135 ({words.number(interval.low)} to {words.number(interval.high)})"
    assert "3 training seeds" in page.text and "best rule, tuned there" in page.text
    assert page.row("s1")[3:6] == ["phase (the paper's UGAT)", "1", "whole"]
    curves = [d.name for d in made.pictures if "seeds" in d.name]
    assert curves == [f"grid2x2-v1-V4-phase-seeds-{w}" for w in ("learning", "att", "gate")]


def test_a_training_without_metrics_is_no_seed_of_a_curve(tmp_path: Path) -> None:
    runs = [make_run(tmp_path / "runs" / f"s{seed}", seed=seed) for seed in range(2)]
    (runs[1] / "metrics.parquet").unlink()
    shutil.rmtree(runs[1] / "trainings")
    made, _ = page_of(tmp_path / "runs")
    assert not [picture.name for picture in made.pictures if "seeds" in picture.name]


def test_runs_whose_worlds_are_unknown_are_no_group(tmp_path: Path) -> None:
    for seed in range(2):
        (make_run(tmp_path / "runs" / f"s{seed}", seed=seed) / "run.json").unlink()
    _, page = page_of(tmp_path / "runs")
    assert "run.json is not there: the hash of its scenario is unknown; it is" in page.text
    assert "Over training seeds" not in page.text


def test_of_many_trainings_those_that_miss_something_keep_their_section(tmp_path: Path) -> None:
    for seed in range(14):
        run = make_run(tmp_path / "runs" / f"s{seed}", seed=seed)
        for file in ("metrics.parquet", "trainings/ugat/checkpoint/metrics.parquet"):
            Metrics([("episode", 0, "return", -1.0)]).write(run / file)  # no gate
    (tmp_path / "runs" / "s3" / "table.json").write_text("{bad")
    _, page = page_of(tmp_path / "runs")
    assert "table.json cannot be used" in page.text
    assert "13 trainings without a gate, whose files are whole" in page.text


def test_a_training_without_a_real_domain_has_no_time_there(tmp_path: Path) -> None:
    for seed in range(2):
        run = make_run(tmp_path / "runs" / f"s{seed}", seed=seed)
        found = evaluation()
        results = tuple(result for result in found.results if result.domain == "sim")
        replace(found, results=results).write(run / "table.json")
    _, page = page_of(tmp_path / "runs")
    assert page.row("s0")[7:9] == ["–", "–"]


def test_why_a_training_is_not_compared(tmp_path: Path) -> None:
    old = make_run(tmp_path / "runs" / "old")
    for file in old.rglob("*"):
        os.utime(file, (1.0, 1.0))
    make_run(tmp_path / "runs" / "new")
    make_run(tmp_path / "runs" / "other", seed=1)
    assert (
        "Left out: old (an older training of the same seed)." in page_of(tmp_path / "runs")[1].text
    )
    rule = Setting("best rule, tuned there", "rule")
    for target in ("sim", "V4"):
        make_job(tmp_path / "jobs", f"rule-{target}", ("sim", "V4"), rule, target=target)
    _, page = page_of(tmp_path / "jobs")
    assert "Left out: rule-sim (made for sim alone)." in page.text
    assert "single-v1: sim, best rule, tuned there" in page.text
    assert "single-v1: sim → V4, best rule, tuned there" in page.text


def test_a_gap_that_turns_longer_the_other_way_is_not_gone(run: Path) -> None:
    found = evaluation()
    times = {("sim", False): 100.0, ("V4", False): 100.5, ("sim", True): 100.0, ("V4", True): 90.0}
    results = tuple(
        replace(r, scores=replace(r.scores, att_s=times[r.domain, r.policy != "direct transfer"]))
        for r in found.results
    )
    replace(found, results=results).write(run / "table.json")
    _, page = page_of(run)
    assert "of the gap Δ is gone" not in page.text and "longer gap Δ" in page.text


def test_one_episode_has_no_interval(run: Path) -> None:
    found = evaluation()
    replace(found, results=tuple(r for r in found.results if r.seed == 1000)).write(
        run / "table.json"
    )
    _, page = page_of(run)
    assert "one episode. Δ:" in page.text
    head = page.text.partition("All measures")[0]
    assert "95 % interval over them" not in head and "One episode." in page.text


def test_tables_alone_are_no_trainings(tmp_path: Path) -> None:
    results = Path(__file__).parents[2] / "results"
    made, _ = page_of(results / "single-v1" / "main-race", results / "mixed-v1" / "main-effects")
    assert "<title>2 tables</title>" in made.text


def test_domains_stand_in_columns_and_what_differs_stays_apart(tmp_path: Path) -> None:
    make_run(tmp_path / "rain", real="V3")
    make_run(tmp_path / "snow", real="V4")
    make_run(tmp_path / "other", duration_s=600.0)
    _, page = page_of(tmp_path / "rain", tmp_path / "snow", tmp_path / "other")
    assert page.text.count("Over training seeds") == 1  # one of its own is not a group
    row = next(
        row for row in page.cells if row[:1] == ["phase (the paper's UGAT)"] and len(row) == 3
    )
    assert row == ["phase (the paper's UGAT)", "132", "132"]  # a single seed has no interval
    assert "1 training seed; no intervals" in page.text


def make_job(folder: Path, name: str, played: Sequence[str], setting: Setting, **more: Any) -> None:
    options = {"observation": "count", "neighbours": 0}
    job = Job(setting, "single-v1", **{"seed": 0, "options": options, **more})
    job.write(folder / name)
    base = 100.0 + 10 * (job.seed or 0)
    played_scores = {
        (0, d, s): scores(base + 50 * (d != "sim") + s) for d in played for s in (0, 1)
    }
    if played_scores:
        JobRecord(played_scores).write(folder / name)


def test_jobs_of_a_paper_make_a_table(tmp_path: Path) -> None:
    direct, oracle = Setting("direct transfer", "direct"), Setting("trained in real", "scratch")
    ugat = UgatConfig(grounding="timed")
    timed = Setting("timed", "grounded", ugat=ugat)
    fixed = replace(timed, ugat=replace(ugat, gate=GateConfig(mode="static", static_alpha=0.5)))
    for seed in (0, 1):
        make_job(tmp_path, f"direct-{seed}", ("sim", "V1", "V4"), direct, seed=seed)
        make_job(tmp_path, f"timed-{seed}", ("sim", "V4"), timed, target="V4", seed=seed)
    make_job(tmp_path, "static", ("sim", "V4"), fixed, target="V4")
    make_job(tmp_path, "waiting", (), oracle, target="V1")
    make_job(tmp_path, "half", ("sim",), oracle, target="V4")
    _, page = page_of(tmp_path)
    row = next(row for row in page.cells if row[:1] == ["direct transfer"] and len(row) == 3)
    interval = Interval.of(np.array([150.5, 160.5]))
    assert row[1] == f"156 ({words.number(interval.low)} to {words.number(interval.high)})"
    assert next(r for r in page.cells if r[:1] == ["timed (gate.mode static)"])[2] == "150"
    assert "Left out: half, waiting (not judged in both domains)." in page.text
    assert page.row("waiting")[5] == "not finished"
    assert page.row("direct-0")[2] == "sim → V1, V4"
    times = page.row("direct-0")[8]
    assert times.startswith("V1 150 (") and ", V4 150 (" in times
    assert page.row("timed-1")[2] == "sim → V4" and page.row("timed-1")[8].startswith("160 (")


def test_a_job_that_is_judged_further_shows_the_seeds_of_every_domain(tmp_path: Path) -> None:
    make_job(tmp_path, "direct-0", (), Setting("direct transfer", "direct"))
    attained = {("sim", 0): 100.0, ("sim", 1): 110.0, ("V4", 1): 150.0}
    played = {(0, domain, seed): scores(att) for (domain, seed), att in attained.items()}
    JobRecord(played).write(tmp_path / "direct-0")
    (record,) = read_records([tmp_path / "direct-0"])
    assert isinstance(record, RunRecord) and record.evaluation is not None
    assert record.evaluation.gap("direct transfer", "V4", "att_s").mean == pytest.approx(40.0)
    page_of(tmp_path / "direct-0")


def test_an_earlier_evaluation_is_not_the_last_one(tmp_path: Path) -> None:
    """Direct transfer is judged in the same job, before the episodes of the method."""
    timed = Setting("timed", "grounded", ugat=UgatConfig(grounding="timed"))
    for seed in (0, 1):
        make_job(tmp_path, f"t{seed}", ("sim", "V4"), timed, target="V4", seed=seed, episodes=3)
    _, page = page_of(tmp_path)
    assert page.row("t0")[5] == "not finished"
    assert "judged after 0 of 3 training episodes" in page.text
    assert "Over training seeds" not in page.text


def test_what_is_still_to_be_judged_is_named(tmp_path: Path) -> None:
    direct = Setting("direct transfer", "direct")
    wanted: dict[str, Any] = {"domains": ("sim", "V1"), "evaluation_seeds": (0, 1, 2)}
    make_job(tmp_path, "d", ("sim",), direct, **wanted)
    _, page = page_of(tmp_path)
    assert "not judged yet in 1 domain ('V1') and it is not judged yet in 1 eval" in page.text


def test_policies_are_compared_on_the_same_episodes(tmp_path: Path) -> None:
    direct, other = Setting("direct transfer", "direct"), Setting("more plain sim", "further")
    for seed in (0, 1):
        make_job(tmp_path, f"d{seed}", ("sim", "V1"), direct, seed=seed)
        make_job(tmp_path, f"m{seed}", ("sim", "V1"), other, seed=seed)
        record = JobRecord.read(tmp_path / f"m{seed}")
        record.scores[0, "sim", 7], record.scores[0, "V1", 7] = scores(900.0), scores(900.0)
        record.write(tmp_path / f"m{seed}")
    _, page = page_of(tmp_path)
    rows = [next(r for r in page.cells if r[:1] == [s.name] and len(r) == 2)
            for s in (direct, other)]  # fmt: skip
    assert rows[0][1] == rows[1][1]
    assert "Left out: 1 evaluation seed on which some policies were not judged." in page.text


def test_a_job_shows_its_worst_minutes(tmp_path: Path) -> None:
    make_job(tmp_path, "direct-0", ("sim", "V4"), Setting("direct transfer", "direct"))
    rows = [("direct transfer", d, 0, m, "A1", 3.0 + m, 6) for d in ("sim", "V4") for m in range(5)]
    pl.DataFrame(rows, schema=queues().schema, orient="row").write_parquet(
        tmp_path / "direct-0" / "queues.parquet"
    )
    _, page = page_of(tmp_path / "direct-0")
    assert "The worst intersections and minutes" in page.text
    assert "direct transfer in V4" in page.text


def test_a_minute_is_that_of_the_episode_where_decisions_are_rare(tmp_path: Path) -> None:
    make_job(tmp_path, "direct-0", ("sim", "V4"), Setting("direct transfer", "direct"))
    rows = [
        ("direct transfer", d, 0, minute, "A1", queue, 6)
        for d in ("sim", "V4")
        for minute, queue in ((1, 2.0), (4, 9.0), (7, 1.0))
    ]
    pl.DataFrame(rows, schema=queues().schema, orient="row").write_parquet(
        tmp_path / "direct-0" / "queues.parquet"
    )
    _, page = page_of(tmp_path / "direct-0")
    (row,) = [row for row in page.cells if row[-1:] == ["minute 4"]]
    assert row[-2] == "9"


def test_a_command_is_read_as_it_was_written() -> None:
    command = "ugat-marl paper main --rows 'direct transfer' 'timed' " + "--seeds 5 " * 20
    lines = command_block(command.strip())
    assert max(map(len, lines)) <= 102
    assert commands_in("\n".join(["# A page", "", *lines, ""])) == [command.strip()]
    assert commands_in("no command") == []
    place = shlex.join(["ugat-marl", "train", "/home/it's/a net"])
    assert commands_in("\n".join(command_block(place))) == [place]


def test_a_finished_table_is_shown_with_its_command() -> None:
    (record,) = read_records([RESULTS / "single-v1" / "main"])
    made, page = page_of(RESULTS / "single-v1" / "main")
    assert "ugat-marl paper main" in page.text
    rows = pl.read_csv(RESULTS / "single-v1" / "main" / "table.csv").rows(named=True)
    for setting in ("direct transfer", "timed"):
        values = [r for r in rows if r["setting"] == setting]
        shown = page.row(setting)[1:]
        for row, cell in zip(values, shown, strict=True):
            low, high = (words.number(row[f"att_s_{end}"]) for end in ("low", "high"))
            assert cell == f"{words.number(row['att_s'])} ({low} to {high})"
    assert sum("radar" in picture.name for picture in made.pictures) == len(shown)
    assert not record.missing


def test_a_folder_of_nothing_and_a_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="neither a run"):
        read_records([tmp_path])
    with pytest.raises(OptionError, match="no such folder"):
        read_records([tmp_path / "x"])
    (tmp_path / "table.json").write_text("{}")
    with pytest.raises(OptionError, match="is a file; give the folder"):
        read_records([tmp_path / "table.json"])


# --- the command --------------------------------------------------------------------------------


def test_the_command_writes_page_and_pictures(run: Path, tmp_path: Path) -> None:
    assert main(["report", str(run), "--pictures", str(tmp_path / "p")]) == 0
    assert Page((run / "report.html").read_text()).text
    assert main(["report", str(run)]) == 0  # its own page may be replaced
    files = sorted(path.name for path in (tmp_path / "p").iterdir())
    assert len(files) >= 16 and {Path(f).suffix for f in files} == {".svg", ".png"}
    for path in (tmp_path / "p").glob("*.png"):
        assert matplotlib.image.imread(path)[:, :, :3].std() > 0.02, path
    for path in (tmp_path / "p").glob("*.svg"):
        assert ET.parse(path).getroot().tag.endswith("svg")


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"seed": 3, "real": "V2", "control": False, "oracle": True, "further": ("V4", "V3")},
        {"duration_s": 600.0, "evaluation_seeds": 2, "corrected": "some dir/x", "sim": "V1"},
        {"ugat": UgatConfig(grounding="timed", iterations=7, least_accuracy=None)},
        {"preset": "paper"},
        {"preset": "paper", "ugat": UgatConfig(iterations=2, pretrain_episodes=20)},
        {"preset": "paper", "learner": "universal"},
        {"learner": "dqn"},
        {"learner": "ippo"},
        {"dqn": DQNConfig(hidden=(48, 48), steps=1)},  # given, though they are those of "dqn"
        {"dqn": DQNConfig(network="mlp")},
    ],
)
def test_the_command_on_the_page_makes_the_same_run(change: dict[str, Any], tmp_path: Path) -> None:
    config = TransferConfig("grid2x2-v1", **change)
    write_settings(tmp_path, config.as_dict())
    (tmp_path / "run.json").write_text("{}")
    (record,) = read_records([tmp_path])
    assert isinstance(record, RunRecord)
    options = train_options(record.settings)
    again = tyro.cli(Train, args=["grid2x2-v1", *options]).config
    assert again == config and again.as_dict() == config.as_dict()


@pytest.mark.parametrize(("inside", "given"), [(".", "."), ("policies", "..")])
def test_a_run_named_by_dots_is_repeated_beside_its_folder(
    run: Path, inside: str, given: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (run / "policies").mkdir()
    monkeypatch.chdir(run / inside)
    (record,) = read_records([Path(given)])
    assert f"--out {run}-again" in again(record)[0]


def test_policies_are_judged_again_with_as_many_seeds(run: Path) -> None:
    (record,) = read_records([run])
    assert isinstance(record, RunRecord)
    (run / "policies").mkdir(exist_ok=True)
    (run / "policies" / "direct-transfer.pt").write_bytes(b"")
    judged = replace(record, settings={**record.settings, "evaluation_seeds": 2})
    (line,) = (line for line in again(judged) if line.startswith("ugat-marl evaluate"))
    assert "--seeds 2 --policies" in line


def test_a_learner_that_lies_elsewhere_is_named_all_the_same() -> None:
    settings = {**TransferConfig("x", learner="ippo").as_dict(), "learner": "nowhere:Thing"}
    settings = json.loads(json.dumps(settings, default=str))
    assert train_options(settings) == ["--learner", "nowhere:Thing"]


def test_nested_settings_come_back_too() -> None:
    settings = TransferConfig("x").as_dict()
    settings["ugat"]["fit"]["warm_start"] = not settings["ugat"]["fit"]["warm_start"]
    settings["ugat"]["gate"]["mode"] = "static"
    settings["dqn"]["hidden"] = [16, 8]
    settings = json.loads(json.dumps(settings, default=str))
    options = train_options(settings)
    config = tyro.cli(Train, args=["x", *options]).config
    assert config.ugat.gate.mode == "static" and config.dqn.hidden == (16, 8)
    assert config.ugat.fit.warm_start is settings["ugat"]["fit"]["warm_start"]


# --- pictures -----------------------------------------------------------------------------------


def test_stretches_of_episodes_have_students_interval() -> None:
    rows = means_by_stretch([[(k, float(k)) for k in range(8)]])
    assert [row[0] for row in rows] == [2.0, 6.0]
    own = Interval.of(np.arange(4.0))
    assert rows[0][1:] == (own.mean, own.low, own.high)
    two = means_by_stretch([[(k, 1.0) for k in range(8)], [(k, 3.0) for k in range(8)]])
    over = Interval.of(np.array([1.0, 3.0]))
    assert two[0][1:] == (over.mean, over.low, over.high)
    assert means_by_stretch([]) == means_by_stretch([[]]) == []
    assert means_by_stretch([[], [(k, float(k)) for k in range(8)]]) == rows


def test_steps_are_joined_over_series() -> None:
    rows = means_by_step([[(0, 1.0), (1, np.inf)], [(0, 3.0)]])
    assert rows[0][1] == 2.0 and rows[0][2] < 1.0
    assert np.isnan(rows[1][1])  # what is infinite once is not a mean


def test_labels_that_would_be_cut_to_the_same_are_cut_in_the_middle() -> None:
    ends = ("all parts and residual, phase", "all parts and residual, timed", "short")
    texts = shortened_apart([f"fitted street: {end}" for end in ends], 34)
    assert texts == [
        "fitted street: al… residual, phase", "fitted street: al… residual, timed",
        "fitted street: short",
    ]  # fmt: skip
    assert shortened_apart(["a", "a"], 34) == ["a", "a"]
    alike = [f"{'x' * 30}{middle}{'y' * 20}" for middle in "aba"]
    first, second, third = shortened_apart(alike, 26)
    assert first == third != second


def test_the_rim_of_a_radar_is_the_best_value() -> None:
    picture = radar_picture("t", {"a": [10, 100, -1, 1, 0.1], "b": [20, 50, -2, 2, 0.2]}, "n")
    assert picture is not None
    text = picture.for_page()
    for best in ("best: 10 s", "best: 100 veh", "best: −1 per step", "best: 1 veh", "best: 0.1<"):
        assert best in text
    assert radar_picture("t", {"a": [np.nan] * 5}, "n") is None


def fills(picture: NamedFigure) -> list[str]:
    return re.findall(r'style="fill: var\(--(\w+)\)', picture.for_page())


def texts(picture: NamedFigure) -> list[str]:
    return re.findall(r">([^<]+)</text>", picture.for_page())


def test_intersections_have_the_colour_of_their_number() -> None:
    network = Network.read(load_scenario("grid2x2-v1"))
    values = {"A1": (0.0, "0"), "A2": (0.5, "50"), "B1": (1.0, "100"), "B2": (np.nan, "")}
    picture = node_map("m", "shares", network, values, (0.0, 1.0), "share")
    tips = re.findall(
        r"<title>(\w+): [^<]*</title>(?:<defs>.*?</defs>)?<g[^>]*><use [^>]*?fill: var\(--(\w+)\)",
        picture.for_page(),
    )
    assert tips == [("A1", "q0"), ("A2", "q3"), ("B1", "q6"), ("B2", "paper")]
    assert {"A1", "50", "–", "shares"} <= set(texts(picture))


def test_the_longest_queues_come_first_minute_by_minute() -> None:
    picture = minutes_picture("m", "queues", {"a": [0.0, 0.0], "b": [7.0, 0.1], "c": [3.5] * 2})
    assert [t for t in texts(picture) if t in "abc"] == ["b", "c", "a"]
    # b: q6 then q0; c: one run of q3; a: one run of q0; then the scale
    areas = [colour for colour in fills(picture) if colour in style.STEPS]
    assert areas == ["q6", "q0", "q3", "q0", *style.STEPS]


def test_the_same_picture_is_the_same_file_and_has_ids_of_its_own() -> None:
    def drawn(name: str) -> NamedFigure:
        picture = radar_picture("t", {"a": [10, 100, -1, 1, 0.1]}, name)
        assert picture is not None
        return picture

    assert drawn("n").svg() == drawn("n").svg()
    assert drawn("n").png() == drawn("n").png()
    ids = [set(re.findall(r' id="([^"]+)"', drawn(name).for_page())) for name in ("n", "m")]
    assert ids[0] and not ids[0] & ids[1]


# --- in a browser -------------------------------------------------------------------------------


@needs_browser
@pytest.mark.parametrize("width", [390, 700, 1440])
def test_nothing_is_clipped_in_a_browser(width: int, tmp_path: Path) -> None:
    for seed in (0, 1):
        make_run(tmp_path / "runs" / f"a-rather-long-name-of-a-run-{seed}", seed=seed)
    page = page_of(tmp_path / "runs")[0].text
    seen = seen_in_browser(page, width, tmp_path, aside="thead")
    assert seen["width"] == width
    assert seen["scroll"] <= width and not seen["wide"], seen["wide"]
    assert not seen["cut"] and not seen["errors"]
    assert not seen["small"] or width < 400
    assert seen["clicks"] == seen["open"] > 3


@needs_browser
@pytest.mark.parametrize("dark", [False, True])
def test_the_page_is_drawn_in_light_and_dark(dark: bool, run: Path, tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text(page_of(run)[0].text)
    assert_drawn(tmp_path / "report.html", dark=dark)


@pytest.mark.parametrize("words", [("--out", "mine.html"), ()])
def test_a_page_of_another_program_is_not_replaced(
    words: tuple[str, ...], run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "other"
    shutil.copytree(run, other)
    monkeypatch.chdir(tmp_path)
    mine = Path(words[1] if words else "report.html")
    mine.write_text("<html>mine</html>")
    assert main(["report", str(run), str(other), *words]) == 2
    assert mine.read_text() == "<html>mine</html>"


# --- a real training ----------------------------------------------------------------------------


@pytest.mark.parametrize("grounding", ["phase", pytest.param("street", marks=pytest.mark.slow)])
def test_a_run_leaves_all_that_its_page_wants(
    grounding: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    search_few_rules(monkeypatch, "largest-queue:20", "programme")
    own: dict[str, Any] = {"sim_rollouts": 1, "fit": FitConfig(epochs=1)}
    if grounding == "street":
        own = {"street": StreetConfig(simulations=20, simulated_s=100.0, judged=1, rule_budget=0)}
    ugat = UgatConfig(
        grounding,
        pretrain_episodes=1,
        iterations=1,
        grounded_episodes=1,
        real_rollouts=1,
        **own,
    )
    learner = "dqn" if grounding == "phase" else "universal"  # the latter takes lessons first
    config = TransferConfig("grid2x2-v1", duration_s=100, evaluation_seeds=2, tuning_seeds=1,
                            control=False, learner=learner, ugat=ugat)  # fmt: skip
    found = transfer(config, tmp_path / "run")
    made, page = page_of(tmp_path / "run")
    assert "Missing here" not in page.text and "whole" in page.text
    assert "The scenario has changed since" not in page.text
    record = read_records([tmp_path / "run"])[0]
    assert isinstance(record, RunRecord) and record.evaluation == found
    assert record.queues is not None and set(record.queues["domain"]) == {"sim", "V4"}
    assert "run-map-queue" in [picture.name for picture in made.pictures]
    assert tyro.cli(Train, args=["grid2x2-v1", *train_options(record.settings)]).config == config


def test_a_table_that_a_spreadsheet_saved_is_read(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("\ufeffsetting,domain,att_s\na,V4,100\nb,V4,90\n", encoding="utf-8")
    assert [row["att_s"] for row in read_rows(path)] == [100.0, 90.0]
    path.write_text("setting,domain,att_s\na,V4,100\na,V4,300\n", encoding="utf-8")
    with pytest.raises(ValueError, match="setting 'a' in V4 is there 2 times"):
        read_rows(path)
    path.write_text("scenario,setting,domain,att_s\nx,a,V4,100\ny,a,V4,300\n", encoding="utf-8")
    with pytest.raises(ValueError, match="rows of several scenarios .x, y.; give each a table"):
        read_rows(path)


def test_an_episode_that_is_there_twice_is_a_damaged_table(run: Path, tmp_path: Path) -> None:
    content = json.loads((run / "table.json").read_text())
    content = {name: value for name, value in content.items() if "hash" not in name}
    content["episodes"].append(content["episodes"][0])
    (tmp_path / "table.json").write_text(json.dumps(content))
    with pytest.raises(CheckpointError, match="an episode is there twice"):
        Evaluation.read(tmp_path / "table.json")
