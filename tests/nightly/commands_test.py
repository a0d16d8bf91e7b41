"""Every command of README, pages and help runs, with small budgets, on files that are made here.

The tutorials are played as they stand by `tutorial_test`.
"""

from __future__ import annotations

import importlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.docs.commands_test import COMMAND_LINES, words_of
from ugat_marl.__main__ import COMMANDS
from ugat_marl.cli.help import options_of
from ugat_marl.grounding.config import GROUNDINGS

ROOT = Path(__file__).resolve().parents[2]

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(1800)]

ELSEWHERE = {
    r"^docs/tutorials/(first-city|your-town|real-street)|street1136": "played by tests of its page",
    r"ugat-marl paper |hangzhou": "played by tables_test",
    r"ugat-marl field ": "waits for a street; played by tests/field",
    r"ugat-marl policy-gap ": "needs a long diagnosis; tests/experiments/policy_gap_test.py",
    r"--ray": "needs Ray; executors_test",
    r"--device cuda": "needs a GPU",
    r"(maskable-p|ip)po": "needs the library of a baseline; `make compat`",
    r"runs/pretraining|runs/ippo": "a file of baselines/",
    r"import-atspm|my-scenario street": "played by tests/data/measured_atspm_test.py",
    r"synchro\.csv": "played by tests/scenarios/signal_plans_test.py",
    r"--cityflow": "played by tests/scenarios/cityflow_test.py",
    r"\.pbf": "played by tests/scenarios/osm_test.py",
    r"\.mp4": "needs the extra video",
    r"\.onnx": "needs the extra onnx; tests/policies/export_test.py",
}
"""What is not run here, by a pattern in its page and line, and why."""

SMALL = {
    "--duration-s": "150",
    "--pretrain-episodes": "1",
    "--iterations": "1",
    "--grounded-episodes": "1",
    "--sim-rollouts": "2",
    "--real-rollouts": "2",
    "--street.simulations": "20",
    "--street.judged": "1",
    "--fit.epochs": "2",
    "--dqn.lesson-updates": "20",
    "--evaluation-seeds": "1",
    "--tuning-seeds": "1",
    "--rule-budget": "11",
    "--budget": "11",
    "--budget-s": "20",
    "--seeds": "1",
    "--periods": "2",
    "--headroom": "1",
}
"""Budgets in place of those of a command that has such an option, or of its defaults."""
ONLY_GIVEN = ("--rule-budget", "--headroom", "--budget-s", "--periods")
"""Budgets that are set only where the command names them, and for the commands of `_ALWAYS`."""
_ALWAYS = {"diagnose": ("--budget-s",), "record": ("--periods",)}

LEARNERS = (ROOT / "docs" / "how-to" / "learners.md").read_text(encoding="utf-8")
ALGORITHM = re.findall(r"```python\n(class MyLearner.*?)```", LEARNERS, flags=re.DOTALL)[0]
"""The user's module, as the page has it."""


COUNT_WITH = {
    "--sim-rollouts": ("phase", "timed"),
    "--fit.epochs": ("phase", "timed"),
    "--street.simulations": ("street",),
    "--street.judged": ("street",),
}
"""Groundings with which some of these budgets count."""


def groundings_of(name: str, words: list[str]) -> set[str]:
    """Groundings of a command: those that it names, or its usual ones."""
    if "--preset" in words or name in ("paper ablation", "paper alpha", "paper uncertainty"):
        return {"phase"}
    if name == "train":
        return {words[words.index("--grounding") + 1] if "--grounding" in words else "street"}
    chosen = "--groundings" in words or "--rows" in words
    return {one for one in GROUNDINGS if not chosen or one in " ".join(words)}


def cases() -> list[Any]:
    """Commands that run here."""
    return [
        case
        for case in COMMAND_LINES
        if not any(re.search(pattern, f"{case.id} {case.values[0]}") for pattern in ELSEWHERE)
    ]


def small(command: str) -> list[str]:
    """The words of a command, with small budgets."""
    words = words_of(command)
    name = next(name for name in (" ".join(words[:2]), words[0]) if name in COMMANDS)
    module, _, attribute = COMMANDS[name][0].partition(":")
    taken = options_of(getattr(importlib.import_module(module), attribute))
    for option, value in SMALL.items():
        given = words[words.index(option) + 1] if option in words else None
        if option not in taken or given == "0":
            continue
        if given is None and option in ONLY_GIVEN and option not in _ALWAYS.get(name, ()):
            continue
        if "--video" in words and option == "--duration-s":
            continue  # a film begins after some minutes
        if option in COUNT_WITH and groundings_of(name, words).isdisjoint(COUNT_WITH[option]):
            continue  # it is refused where it would do nothing
        if "--preset" in words and "." in option:
            continue  # the preset decides
        if given is None and (name.startswith(("scenario", "plan")) and option == "--duration-s"):
            continue
        if name == "plan" and "--policy" not in words:
            continue  # no episode is played
        if name == "compare" and "--policies" in words and option in ("--seeds", "--episodes"):
            continue  # nothing is trained
        if "--learner" in words and option.startswith("--dqn."):
            continue  # settings of another learner
        if given is None:
            words += [option, value]
        else:
            words[words.index(option) + 1] = value
    return words


def run(folder: Path, *words: str) -> None:
    """Run a command in a folder."""
    done = subprocess.run(
        [sys.executable, "-P", "-m", "ugat_marl", "--quiet", *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    problems = ("scenario", "check")  # exit code 1 says that something has to be fixed
    fine = (0, 1) if tuple(words[:2]) == problems and "Traceback" not in done.stderr else (0,)
    assert done.returncode in fine, f"{words}\n{done.stdout[-1000:]}\n{done.stderr[-2000:]}"


@pytest.fixture(scope="module")
def stock(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with everything that the pages speak of."""
    folder = tmp_path_factory.mktemp("stock")
    for name in ("tests", "docs", "results"):
        (folder / name).symlink_to(ROOT / name)
    (folder / "my_algo.py").write_text(ALGORITHM)
    for name in ("town.osm", "my-city.osm"):
        shutil.copyfile(ROOT / "tests" / "fixtures" / "town.osm", folder / name)

    def do(command: str) -> None:
        run(folder, *small(f"ugat-marl {command}"))

    do("scenario new town --osm town.osm --counts docs/tutorials/town/counts.csv")
    do("scenario new try-town --osm town.osm --counts docs/tutorials/town/counts.csv")
    do("scenario new my-grid --grid 1x2 --vph 200 --duration-s 600")
    do("scenario new my-town --arterial 2 --vph 200 --duration-s 600")
    for name in ("my-city", "my-scenario"):  # the network of found/corrected and of the logs
        shutil.copytree(ROOT / "scenarios" / "single-v1", folder / name)
    do("plan single-v1 --out plans.csv")
    do("plan single-v1 --apply plans.csv --out my-planned")
    for name in ("diagnosis", "found", "corrected"):
        shutil.copytree(ROOT / "scenarios" / "single-v1", folder / name / "corrected")
    for place in ("my.sumocfg", "city.sumocfg", "path/to/my.sumocfg"):
        configure(folder, place)
    for scenario in ("single-v1", "grid2x2-v1"):
        do(f"train {scenario} --real V4 --out {scenario}/first --no-control")
        for name in ("second", "demo", "s0", "s1", "corrected", "street", "paper", "paper-small"):
            shutil.copytree(folder / scenario / "first", folder / scenario / name)
        do(f"record {scenario} --domain V4 --lanes --out {scenario}-measured")
        do(f"rollout {scenario} --domain V4 --episodes 2 --out {scenario}.parquet --crossings")
    return folder


def configure(folder: Path, place: str) -> None:
    """Write a configuration of SUMO, beside the files that it names."""
    source = ROOT / "tests" / "fixtures" / "crossing"
    target = (folder / place).parent
    target.mkdir(parents=True, exist_ok=True)
    names = {"network.net.xml": "city.net.xml", "demand.rou.xml": "cars.rou.xml"}
    for name, copy in names.items():
        shutil.copyfile(source / name, target / copy)
    (folder / place).write_text(
        '<configuration><input><net-file value="city.net.xml"/><route-files value="cars.rou.xml"/>'
        '</input><time><begin value="0"/><end value="600"/></time></configuration>'
    )


def test_nothing_is_left_out_without_a_reason() -> None:
    assert len(cases()) > 70
    lines = [f"{case.id} {case.values[0]}" for case in COMMAND_LINES]
    for pattern in ELSEWHERE:
        assert any(re.search(pattern, line) for line in lines), f"{pattern} matches nothing"


@pytest.mark.parametrize("command", cases())
def test_a_documented_command_runs(command: str, stock: Path, tmp_path: Path) -> None:
    folder = tmp_path / "here"
    shutil.copytree(stock, folder, symlinks=True)
    words = small(command)
    scenario = "grid2x2-v1" if "grid2x2-v1" in words else "single-v1"
    shutil.copytree(folder / scenario, folder / "runs")
    for name in ("measured", "street"):
        shutil.copytree(folder / f"{scenario}-measured", folder / name)
    for name in ("real", "measured", "street"):
        shutil.copyfile(folder / f"{scenario}.parquet", folder / f"{name}.parquet")
    shutil.copyfile(folder / "runs/first/policies/direct-transfer.pt", folder / "mine.pt")
    if words[:3] == ["diagnose", "my.sumocfg", "street"]:  # data of this network
        shutil.rmtree(folder / "street")
        run(folder, *small("ugat-marl record my.sumocfg --domain V4 --out street"))
    filled_in = "town/counts.csv" in words or "my-town/counts.csv" in words
    if filled_in:  # by the user
        name = words[words.index("--counts") + 1].partition("/")[0]
        shutil.rmtree(folder / name)
        run(folder, "scenario", "new", name, "--osm", "town.osm")
        counts = ROOT / "docs" / "tutorials" / "town" / "counts.csv"
        shutil.copyfile(counts, folder / name / "counts.csv")
    goal = next((words[2] for _ in words if words[:2] == ["scenario", "new"]), "")
    for made in {goal, *(words[words.index("--out") + 1 :][:1] if "--out" in words else [])}:
        place = folder / made
        if made and words.count(made) == 1 and not filled_in:  # made here, and now by the command
            if place.is_dir():
                shutil.rmtree(place)
            place.unlink(missing_ok=True)
    run(folder, *words)
