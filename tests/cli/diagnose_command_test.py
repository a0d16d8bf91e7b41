"""`ugat-marl diagnose` from end to end on two roads that cross: says, writes, and refuses what."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from ugat_marl.__main__ import main
from ugat_marl.cli import diagnose as command
from ugat_marl.data import CSV_HASHES, write_measured
from ugat_marl.diagnosis import DetectionLimit, DiagnosisConfig, Pattern
from ugat_marl.diagnosis.thresholds import Effort
from ugat_marl.effects import known_effects, load_scenario
from ugat_marl.experiments import policy_factory, record
from ugat_marl.reporting.diagnosis_words import VERDICTS
from ugat_marl.scenarios import Network

FEW = Effort(base=14, bank=2, fit=4, test=12)
EXAMINED = ("late_green", "gap_acceptance")
LEFT_OUT = tuple(sorted(set(known_effects()) - {*EXAMINED, "yellow_time", "all_red_time"}))


@dataclass(frozen=True)
class Street:
    """A scenario and data of it.

    Attributes:
        scenario: The crossing with a car every 9 s on each road, for ten minutes.
        measured: Three days on which every green begins 4 s late; as CSV.
        cache: Remembered simulations.
    """

    scenario: Path
    measured: Path
    cache: Path

    def arguments(self, out: Path, *more: str, measured: Path | None = None) -> list[str]:
        return [
            "diagnose", str(self.scenario), str(measured or self.measured), "--out", str(out),
            "--cache", str(self.cache), *more, "--leave-out", *LEFT_OUT,
        ]  # fmt: skip


def busy(data: Path, directory: Path, gap_s: int = 9, count: int = 66) -> Path:
    """The crossing for ten minutes, with a car every so many seconds on each road."""
    shutil.copytree(data / "crossing", directory)
    toml = (data / "crossing" / "scenario.toml").read_text()
    (directory / "scenario.toml").write_text(toml.replace("duration_s = 200", "duration_s = 600"))
    departures = sorted(
        (gap_s * i + (4 if road == "east" else 0), road, i)
        for i in range(count)
        for road in ("north", "east")
    )
    vehicles = "".join(
        f'<vehicle id="{road}{i}" type="car" route="{road}" depart="{time_s}"/>'
        for time_s, road, i in departures
    )
    (directory / "demand.rou.xml").write_text(
        f"""<routes>
        <vType id="car" length="5" minGap="2.5" accel="2.5" decel="4.5" sigma="0"/>
        <route id="north" edges="S_C C_N"/><route id="east" edges="W_C C_E"/>{vehicles}</routes>"""
    )
    return directory


@pytest.fixture(scope="module")
def street(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Street:
    directory = tmp_path_factory.mktemp("street")
    scenario = busy(data, directory / "busy-v1")
    measured = record(
        load_scenario(scenario),
        "late_green=*,4",
        policy_factory("fixed-time:20"),
        periods=3,
        workers=2,
    )
    return Street(scenario, write(measured, directory / "measured"), directory / "cache")


def write(data: Any, directory: Path) -> Path:
    write_measured(data, directory, csv=True)
    (directory / CSV_HASHES).unlink()  # tests edit the tables by hand
    return directory


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few simulated days: enough for effects as large as these."""
    small = functools.partial(DiagnosisConfig, effort=FEW)
    monkeypatch.setattr(command, "DiagnosisConfig", small)


def hashes(directory: Path) -> dict[str, str]:
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in directory.rglob("*")
        if path.is_file()
    }


@pytest.fixture(scope="module")
def found(street: Street, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, str]:
    """A diagnosis that ran through: its directory, and what it said."""
    out = tmp_path_factory.mktemp("found") / "deep" / "found"
    before = hashes(street.measured)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "DiagnosisConfig", functools.partial(DiagnosisConfig, effort=FEW))
        said = Capture()
        with contextlib.redirect_stdout(said.out), contextlib.redirect_stderr(said.err):
            assert main(street.arguments(out)) == 0
    assert hashes(street.measured) == before
    return out, said.out.getvalue(), said.err.getvalue()


class Capture:
    """What a command writes."""

    def __init__(self) -> None:
        import io

        self.out, self.err = io.StringIO(), io.StringIO()


def test_it_names_the_effect_and_says_what_to_do_with_it(
    found: tuple[Path, str, str], street: Street
) -> None:
    out, text, errors = found
    assert not errors
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "diagnose.md").read_text()
    (options,) = re.findall("train my-city --sim found/corrected (.*) --out", page)
    flat = " ".join(text.split())
    for part in (
        "late green",
        "everywhere",
        "strongest disagreements",
        "held-out periods",
        "GEH < 5",
        f"diagnosis: {out / 'diagnosis.json'}",
        f"page: {out / 'report.html'}",
        f"ugat-marl train {street.scenario} --sim {out / 'corrected'} {options}",
    ):
        assert part in flat or part in text, part
    assert "Partial" not in text
    lines = [line for line in text.splitlines() if str(out) not in line]
    assert max(map(len, lines)) <= 80


def test_it_writes_record_page_and_a_scenario_that_can_be_used(
    found: tuple[Path, str, str], street: Street
) -> None:
    out, _, _ = found
    diagnosed = json.loads((out / "diagnosis.json").read_text())
    assert diagnosed["verdict"] == "explained"
    (effect,) = diagnosed["effects"]
    assert effect["name"] == "late_green"
    assert effect["parameters"]["seconds"]["value"] == pytest.approx(4.0, abs=0.3)
    assert diagnosed["heldout"]["shrink"] > 0.97
    page = (out / "report.html").read_text()
    assert diagnosed["sentence"] in page
    assert "--leave-out" in page
    corrected = load_scenario(str(out / "corrected"))
    assert corrected.hash != load_scenario(street.scenario).hash
    assert Network.read(corrected).intersections
    assert {path.name for path in out.iterdir()} == {"corrected", "diagnosis.json", "report.html"}


@pytest.mark.usefixtures("few")
def test_the_same_data_and_seed_give_the_same_json(
    found: tuple[Path, str, str], street: Street, tmp_path: Path
) -> None:
    assert main([*street.arguments(tmp_path / "again", "--no-report")]) == 0
    first, second = found[0] / "diagnosis.json", tmp_path / "again" / "diagnosis.json"
    assert first.read_bytes() == second.read_bytes()
    assert not (tmp_path / "again" / "report.html").exists()


@pytest.mark.usefixtures("few")
def test_nothing_is_named_that_the_library_lacks(
    street: Street, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(street.scenario, tmp_path / "corrected")  # of an earlier diagnosis
    assert main([*street.arguments(tmp_path), "late_green"]) == 0
    diagnosed = json.loads((tmp_path / "diagnosis.json").read_text())
    assert diagnosed["verdict"] == "unknown"
    assert not diagnosed["effects"]
    text = capsys.readouterr().out
    assert not (tmp_path / "corrected").exists()
    assert "of an earlier diagnosis is removed, since" in " ".join(text.split())
    assert "use it" not in text
    assert diagnosed["sentence"] in (tmp_path / "report.html").read_text()


KEYS = re.compile(r"^\| `([\w.\[\]<>-]+)` \| [a-z ,]+ \|", flags=re.MULTILINE)
LIKE_ANOTHER = ("left", "alternatives[].effects", "best.effects", "unnamed")
"""Lists of what is described elsewhere on the page."""
SOMETIMES = (
    {"effects[].evidence.source", "effects[].evidence.rival", "policy_gap", "traffic_check"}
    | {f"patterns[].{field}" for field in Pattern.__dataclass_fields__}
    | {f"limits[].{field}" for field in DetectionLimit.__dataclass_fields__}
    | {f"alternatives[].{key}" for key in ("effects", "distance", "cost", "indistinct")}
)


def keys_of(value: Any, path: str = "") -> set[str]:
    """The paths of all values; names of fields and policies are one each."""
    if isinstance(value, list):
        records = [item for item in value if isinstance(item, dict)]
        if not records or path in LIKE_ANOTHER:
            return {path}
        return {key for item in records for key in keys_of(item, f"{path}[]")}
    if not isinstance(value, dict):
        return {path}
    free = {"parameters": "<field>", "policy_gap": "<policy>"}.get(path.rpartition(".")[2])
    found: set[str] = set()
    for key, item in value.items():
        found |= keys_of(item, ".".join(filter(None, (path, free or key))))
    return found


GAP = {
    "max-pressure:20": {
        name: {"mean": 1.0, "low": 0.0, "high": 2.0} for name in ("sim", "corrected", "real")
    }
    | {"before": 2.0, "after": 1.0, "shrink": 0.5}
}


def test_the_manual_lists_exactly_the_keys_there_are(found: tuple[Path, str, str]) -> None:
    diagnosed = json.loads((found[0] / "diagnosis.json").read_text())
    page = (Path(__file__).parents[2] / "docs" / "reference" / "diagnosis-file.md").read_text()
    assert diagnosed["schema"] in page
    listed = KEYS.findall(page.partition("## diagnosis.json")[2])
    assert len(listed) == len(set(listed))
    there = keys_of(diagnosed | {"policy_gap": GAP}) - {"alternatives", "patterns"}
    assert there - set(listed) == set()
    assert set(listed) - there - SOMETIMES == set()


@pytest.mark.slow
@pytest.mark.usefixtures("few")
def test_the_policy_gap_stays_as_long_as_the_same_is_found(
    found: tuple[Path, str, str], street: Street, tmp_path: Path
) -> None:
    file, page = tmp_path / "diagnosis.json", tmp_path / "report.html"
    before = json.loads((found[0] / "diagnosis.json").read_text())
    file.write_text(json.dumps(before | {"policy_gap": GAP}))
    assert main(street.arguments(tmp_path)) == 0
    assert json.loads(file.read_text()) == before | {"policy_gap": GAP}
    assert "max-pressure:20" in page.read_text()
    (effect,) = before["effects"]
    seconds = effect["parameters"]["seconds"] | {"value": 5.0}
    others = {
        "effects": [effect | {"parameters": {"seconds": seconds}}],
        "hashes": {},
        "unnamed": [effect],
        "corrected": None,
    }
    for key, value in others.items():
        file.write_text(json.dumps(before | {"policy_gap": GAP, key: value}))
        assert main(street.arguments(tmp_path, "--no-report")) == 0
        assert json.loads(file.read_text()) == before, key


def test_every_verdict_is_explained_in_the_manual() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "diagnosis-file.md").read_text()
    table = page.partition("## Verdicts")[2].partition("##")[0]
    assert set(re.findall(r"^\| `(\w+)`", table, flags=re.MULTILINE)) == set(VERDICTS)


def test_the_steps_in_the_manual_run_one_by_one(
    street: Street, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "diagnose.md").read_text()
    (text,) = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    names = {"FEW": FEW, "LEFT_OUT": LEFT_OUT, "CACHE": street.cache}
    for old, new in (
        ('"single-v1"', repr(str(street.scenario))),
        ('"measured"', repr(str(street.measured))),
        ('"by-hand"', repr(str(tmp_path / "by-hand"))),
        ("budget_h=900", "effort=FEW, leave_out=LEFT_OUT, cache=CACHE"),
    ):
        assert text.count(old) == 1
        text = text.replace(old, new)
    exec(text, names)  # the page's own words
    *places, fitted, verified, sentence = capsys.readouterr().out.splitlines()
    assert places[0].split()[0] == "C"
    assert fitted.startswith("late_green=*,4")
    assert 0.5 < float(verified) <= 1.0
    assert sentence.startswith("The street has late green of 4 s")
    assert load_scenario(tmp_path / "by-hand").hash != load_scenario(street.scenario).hash


# ---------------------------------------------------------------- stopping and going on


@pytest.mark.usefixtures("few")
def test_stopped_and_started_again_it_ends_with_the_same_json(
    found: tuple[Path, str, str],
    street: Street,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    fresh = Street(street.scenario, street.measured, tmp_path / "cache")
    done = 0

    class Stopped(command.Bars):
        @contextlib.contextmanager
        def task(self, name: str, total: int) -> Any:
            def advance(note: str = "") -> None:
                nonlocal done
                done += 1
                if done == 20:
                    raise KeyboardInterrupt

            yield advance

    with monkeypatch.context() as patch:
        patch.setattr(command, "Bars", Stopped)
        assert main(fresh.arguments(tmp_path / "out")) == 130
    errors = capsys.readouterr().err
    assert errors == "ugat-marl: interrupted; the same command goes on where it stopped\n"
    assert not (tmp_path / "out" / "diagnosis.json").exists()
    remembered = set(fresh.cache.rglob("*.npz"))
    assert len(remembered) >= 14
    assert main(fresh.arguments(tmp_path / "out")) == 0
    assert remembered < set(fresh.cache.rglob("*.npz"))
    first, second = found[0] / "diagnosis.json", tmp_path / "out" / "diagnosis.json"
    assert first.read_bytes() == second.read_bytes()


def test_control_c_is_one_line(street: Street, tmp_path: Path, python: list[str]) -> None:
    cache = tmp_path / "cache"
    arguments = Street(street.scenario, street.measured, cache).arguments(tmp_path / "out")
    process = subprocess.Popen(
        [*python, "-m", "ugat_marl", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    until = time.monotonic() + 60
    while not list(cache.rglob("*.npz")) and time.monotonic() < until:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert errors == "ugat-marl: interrupted; the same command goes on where it stopped\n"


def test_a_budget_too_small_for_anything_says_so(
    street: Street, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fresh = Street(street.scenario, street.measured, tmp_path / "cache")
    assert main(fresh.arguments(tmp_path / "out", "--budget-s", "0.01")) == 0
    text = " ".join(capsys.readouterr().out.split())
    diagnosed = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert (diagnosed["verdict"], diagnosed["complete"]) == ("provisional", False)
    assert "Partial result: the budget of 0.01 s (--budget-s) ended" in text
    assert "held-out periods" not in text
    assert "Partial result" in (tmp_path / "out" / "report.html").read_text()
    assert "There is no corrected scenario: no effect was found to correct it by." in text


def count_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    """A second passes with each look: simulations count, and not the speed of this machine."""
    ticks = iter(range(10**6))
    monkeypatch.setattr("ugat_marl.diagnosis.engine.time.monotonic", lambda: float(next(ticks)))


@pytest.mark.usefixtures("few")
def test_a_budget_that_ends_in_the_search_gives_a_partial_result(
    street: Street,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cache = tmp_path / "cache"
    fresh = Street(street.scenario, street.measured, cache)
    count_seconds(monkeypatch)
    assert main(fresh.arguments(tmp_path / "out", "--budget-s", "18", "--workers", "1")) == 0
    text = " ".join(capsys.readouterr().out.split())
    diagnosed = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert diagnosed["complete"] is False
    assert "Partial result: the budget of 18 s (--budget-s) ended" in text
    assert "Partial result" in (tmp_path / "out" / "report.html").read_text()


# ---------------------------------------------------------------- bad input

Spoil = Callable[[Path], object]


def edited(name: str, edit: Callable[[list[str]], list[str]]) -> Spoil:
    def spoil(directory: Path) -> None:
        file = directory / name
        head, *rows = file.read_text().splitlines()
        file.write_text("\n".join([head, *edit(rows)]) + "\n")

    return spoil


def cell(column: int, text: str, row: int = 5) -> Callable[[list[str]], list[str]]:
    def edit(rows: list[str]) -> list[str]:
        cells = rows[row].split(",")
        cells[column] = text
        return [*rows[:row], ",".join(cells), *rows[row + 1 :]]

    return edit


def half(name: str) -> Spoil:
    def spoil(directory: Path) -> None:
        data = (directory / name).read_bytes()
        (directory / name).write_bytes(data[: data.index(b"\n", len(data) // 2) + 3])

    return spoil


def only(name: str, keep: Callable[[str], bool]) -> Spoil:
    return edited(name, lambda rows: [row for row in rows if keep(row)])


def both(*spoils: Spoil) -> Spoil:
    return lambda directory: [spoil(directory) for spoil in spoils]


DETECTIONS, SIGNALS, PERIODS, DETECTORS = (
    f"{name}.csv" for name in ("detections", "signals", "periods", "detectors")
)

REFUSED: list[tuple[str, Spoil, str]] = [
    ("empty periods", only(PERIODS, lambda _: False), "periods.csv"),
    ("empty detections", only(DETECTIONS, lambda _: False), "no detections"),
    ("no file of detections", lambda d: (d / DETECTIONS).unlink(), "detections"),
    ("a lane that is not there", edited(DETECTORS, cell(1, "S_C_7", 0)), "'S_C_7'"),
    ("a state of another length", edited(SIGNALS, cell(3, "GGG", 1)), "'GGG'"),
    ("a row before its period", edited(SIGNALS, cell(1, "-80", 4)), "signals.csv"),
    ("a clock set back", edited(SIGNALS, lambda rows: rows[:20] + rows[:20]), "signals.csv"),
    ("a negative speed", edited(DETECTIONS, cell(4, "-3")), "speed_mps"),
    ("text in a column of numbers", edited(DETECTIONS, cell(1, "noon")), "'noon'"),
    ("detections cut in half", half(DETECTIONS), "detections.csv"),
    ("periods that end before they begin", edited(PERIODS, cell(2, "-1", 0)), "periods.csv"),
    ("a period twice", edited(PERIODS, lambda rows: [rows[0], *rows]), "periods.csv"),
    ("periods beyond the demand", edited(PERIODS, cell(2, "90000", 0)), "periods.csv"),
    ("periods after the demand", both(*(
        edited(PERIODS, cell(c, v, r)) for r in range(3) for c, v in ((1, "9000"), (2, "9900"))
    )), "periods.csv"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("spoil", "says"), [case[1:] for case in REFUSED], ids=[case[0] for case in REFUSED]
)
def test_bad_data_are_refused_in_one_line(
    spoil: Spoil,
    says: str,
    street: Street,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    measured = tmp_path / "measured"
    shutil.copytree(street.measured, measured)
    spoil(measured)
    before = hashes(measured)
    assert main(street.arguments(tmp_path / "out", measured=measured)) == 2
    out, errors = capsys.readouterr()
    assert "Traceback" not in out + errors
    assert len(errors.splitlines()) == 1
    assert says in errors
    assert hashes(measured) == before
    assert not (tmp_path / "out").exists()


def every_other_detector(directory: Path) -> None:
    rows = (directory / DETECTORS).read_text().splitlines()[1:]
    silent = {row.split(",")[0] for row in rows[::2]}
    only(DETECTIONS, lambda row: row.split(",")[2] not in silent)(directory)


POOR: list[tuple[str, Spoil, str]] = [
    ("one period", both(*(
        only(name, lambda row: row.startswith("day1,")) for name in (PERIODS, SIGNALS, DETECTIONS)
    )), "only one period, so none is held out"),
    ("half of the detectors say nothing", every_other_detector, "note: "),
    ("a clock set forward", edited(DETECTIONS, lambda rows: [
        row for row in rows if not 50 < float(row.split(",")[1]) < 560
    ]), "note: "),
    ("speeds that are NaN", edited(DETECTIONS, lambda rows: [
        ",".join([*row.split(",")[:4], "NaN", ""]) for row in rows
    ]), "Ruled out by what the data lack: speed_spread."),
    ("rows out of order", edited(DETECTIONS, lambda rows: rows[::-1]), "note: "),
]  # fmt: skip


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize(
    ("spoil", "says"), [case[1:] for case in POOR], ids=[case[0] for case in POOR]
)
def test_poor_data_give_a_result_that_says_so(
    spoil: Spoil,
    says: str,
    street: Street,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    measured = tmp_path / "measured"
    shutil.copytree(street.measured, measured)
    spoil(measured)
    before = hashes(measured)
    count_seconds(monkeypatch)  # many of them are partial results, which is as good here
    assert main(street.arguments(tmp_path / "out", "--budget-s", "30", measured=measured)) == 0
    out, errors = capsys.readouterr()
    assert not errors
    assert says in " ".join(out.split())
    assert hashes(measured) == before
    diagnosed = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert diagnosed["findings"]


@pytest.mark.usefixtures("few")
def test_counts_alone_are_announced_before_anything_runs(
    street: Street, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    measured = tmp_path / "measured"
    shutil.copytree(street.measured, measured)
    rows = (measured / DETECTORS).read_text().splitlines()[1:]
    counts = [
        f"day{day},{begin},{begin + 300},{row.split(',')[0]},33"
        for day in (1, 2, 3)
        for begin in (0, 300)
        for row in rows
    ]
    head = "period_id,begin_s,end_s,detector_id,count"
    (measured / "counts.csv").write_text("\n".join([head, *counts]) + "\n")
    (measured / DETECTIONS).unlink()
    assert main(street.arguments(tmp_path / "out", measured=measured)) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "counts only, no detections of single vehicles: only" in text
    assert "Ruled out" not in text, "once is enough"


def test_demand_that_does_not_reach_the_detectors_is_told(
    data: Path, street: Street, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All cars come from the south, and only the road from the west is measured."""
    scenario = busy(data, tmp_path / "south-v1")
    routes = scenario / "demand.rou.xml"
    routes.write_text(routes.read_text().replace('route="east"', 'route="north"'))
    measured = tmp_path / "measured"
    shutil.copytree(street.measured, measured)
    for name in (DETECTORS, DETECTIONS):
        only(name, lambda row: "W_C" in row or "C_E" in row)(measured)
    other = Street(scenario, measured, tmp_path / "cache")
    assert main(other.arguments(tmp_path / "out")) == 2
    _, errors = capsys.readouterr()
    assert len(errors.splitlines()) == 1
    assert "no vehicle of its demand comes over a measured edge (C_E, W_C)" in errors


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (("--alpha", "0.7"), "--alpha 0.7"),
        (("--budget-s", "0"), "--budget-s 0"),
        (("--budget-s", "nan"), "--budget-s nan"),
        (("--seed", "-1"), "--seed -1"),
        (("--workers", "0"), "--workers 0: must be at least 1"),
        (("--budgets", "3"), "'--budget-s'"),
    ],
)
def test_impossible_options_are_refused(
    more: tuple[str, ...],
    says: str,
    street: Street,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(street.arguments(tmp_path / "out", *more)) == 2
    errors = capsys.readouterr().err
    assert len(errors.splitlines()) == 1
    assert says in errors


def test_an_unknown_effect_is_guessed(
    street: Street, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*street.arguments(tmp_path / "out"), "headwy"]) == 2
    assert "'headway'" in capsys.readouterr().err


@pytest.mark.parametrize("inside", ["", "found"])
def test_nothing_is_written_among_the_measured_data(
    inside: str, street: Street, capsys: pytest.CaptureFixture[str]
) -> None:
    before = hashes(street.measured)
    assert main(street.arguments(street.measured / inside)) == 2
    assert "never written to" in capsys.readouterr().err
    assert hashes(street.measured) == before


def test_the_corrected_scenario_is_not_replaced_while_it_is_diagnosed(
    found: tuple[Path, str, str], street: Street, capsys: pytest.CaptureFixture[str]
) -> None:
    out, _, _ = found
    before = hashes(out)
    scenario = str(out / "corrected")
    assert main(["diagnose", scenario, str(street.measured), "--out", str(out)]) == 2
    assert "give another directory" in " ".join(capsys.readouterr().err.split())
    assert hashes(out) == before


def test_a_folder_that_no_diagnosis_wrote_is_not_replaced(
    street: Street, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    notes = tmp_path / "corrected" / "notes.txt"
    notes.parent.mkdir()
    notes.write_text("mine")
    assert main(street.arguments(tmp_path)) == 2
    assert "is no scenario" in " ".join(capsys.readouterr().err.split())
    assert notes.read_text() == "mine"


def test_a_page_of_something_else_is_not_removed(
    street: Street, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "report.html"
    head = '<!DOCTYPE html>\n<meta name="generator" content="ugat_marl">\n<title>{}</title>'
    page.write_text(text := head.format("Run first: dqn on single-v1"))
    assert main(street.arguments(tmp_path, "--no-report")) == 2
    assert "no page of ugat_marl titled 'Diagnosis of ...'" in capsys.readouterr().err
    assert page.read_text() == text


def test_a_cache_that_cannot_be_written_is_named_before_anything_runs(
    street: Street, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("in the way")
    arguments = [*street.arguments(tmp_path / "out"), "--cache", str(tmp_path / "file" / "cache")]
    assert main(arguments) == 2
    said = capsys.readouterr()
    assert "with --cache" in " ".join(said.err.split())
    assert "measured" not in said.out
