"""Learners by name: what is found, what is refused, and that UGAT trains any of them."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.interrupts import KillAt
from tests.runs import SMALL, search_few_rules
from ugat_marl.errors import CheckpointError, OptionError, UnknownNameError
from ugat_marl.experiments import policy_factory, transfer
from ugat_marl.policies import BASELINES, DQN, Learner, NetworkPolicy, learner_factory
from ugat_marl.policies.learners import catalogue
from ugat_marl.policies.learners.catalogue import Baseline
from ugat_marl.policies.learners.dqn import DQNConfig
from ugat_marl.testing import ToyTraffic

if not catalogue.baselines_folder().is_dir():
    pytest.skip("baselines/ is neither here nor in the package", allow_module_level=True)

PLAIN = """
from dataclasses import dataclass

@dataclass(frozen=True)
class Config:
    rate: float = 0.1
    sizes: tuple[int, ...] = (1, 2)
    deep: bool = False
    scale: float | None = 1.0
    kind: str = "one"

class Plain:
    def __init__(self, env, config, seed):
        self.config, self.seed = config, seed
"""
IPPO = replace(
    SMALL,
    learner="ippo",
    learner_settings=("hidden=16", "update_every=5", "epochs=2"),
    control=True,
    dqn=DQNConfig(),
)


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of baselines, in place of the suite's own."""
    (tmp_path / "plain.py").write_text(PLAIN)
    (tmp_path / "needy.py").write_text("import no_such_library.inside\n")
    (tmp_path / "broken.py").write_text("raise ValueError('its own')\n")
    named = {
        "plain": Baseline("plain", "Plain", "Config"),
        "second": Baseline("plain", "Plain", "Config", settings={"kind": "two"}),
        "needy": Baseline("needy", "Plain", "Config", "needs"),
        "broken": Baseline("broken", "Plain", "Config"),
        "gone": Baseline("gone", "Plain", "Config"),
    }
    monkeypatch.setattr(catalogue, "BASELINES", named)
    monkeypatch.setattr(catalogue, "baselines_folder", lambda: tmp_path)
    for name in named:
        monkeypatch.delitem(sys.modules, f"ugat_marl_baseline_{name}", raising=False)
    return tmp_path


def made(name: str, *settings: str) -> Any:
    return learner_factory(name, settings)(ToyTraffic(), 7)


@pytest.mark.usefixtures("planted")
def test_settings_are_of_their_type() -> None:
    learner = made("plain", "rate=1e-3", "sizes=8,9,10", "deep=true", "scale=none", "kind=x=y")
    assert vars(learner.config) == {
        "rate": 1e-3, "sizes": (8, 9, 10), "deep": True, "scale": None, "kind": "x=y"
    }  # fmt: skip
    assert learner.seed == 7
    assert made("plain", "sizes=4").config.sizes == (4,)
    assert made("second").config.kind == "two"


@pytest.mark.usefixtures("planted")
@pytest.mark.parametrize(
    ("name", "settings", "kind", "says"),
    [
        ("plane", [], UnknownNameError, "'plain'"),
        ("plain", ["raet=1"], UnknownNameError, "'rate'"),
        ("plain", ["rate"], OptionError, "NAME=VALUE"),
        ("plain", ["rate="], OptionError, "NAME=VALUE"),
        ("plain", ["rate=fast"], OptionError, "rate=fast"),
        ("plain", ["sizes=1,x"], OptionError, "sizes=1,x"),
        ("second", ["kind=three"], UnknownNameError, "kind"),  # its name has said it
        ("needy", [], OptionError, "no_such_library.*\\[needs"),
        ("gone", [], OptionError, "gone.py"),
        ("broken", [], ValueError, "its own"),
        ("dqn", ["hidden=3"], OptionError, "--dqn"),
    ],
)
def test_what_cannot_be_is_refused(
    name: str, settings: list[str], kind: type[Exception], says: str
) -> None:
    for _ in range(2):  # a failed import leaves nothing behind
        with pytest.raises(kind, match=says):
            made(name, *settings)


def test_dqn_is_the_suites_own() -> None:
    learner = learner_factory("dqn", dqn=DQNConfig(hidden=(5,)))(ToyTraffic(), 3)
    assert isinstance(learner, DQN) and learner.config.hidden == (5,)
    assert np.array_equal(
        learner.policy().parameters,
        DQN.of(ToyTraffic(), DQNConfig(hidden=(5,)), 3).policy().parameters,
    )


def test_every_baseline_has_a_file_and_an_extra() -> None:
    import tomllib

    folder = catalogue.baselines_folder()
    assert {f"{item.file}.py" for item in BASELINES.values()} <= {p.name for p in folder.iterdir()}
    project = Path(__file__).resolve().parents[2] / "pyproject.toml"
    extras = tomllib.loads(project.read_text())["project"]["optional-dependencies"]
    assert {item.extra for item in BASELINES.values() if item.extra} <= set(extras)


def test_names_choose_the_settings() -> None:
    for name, centralised in (("ippo", False), ("mappo", True)):
        learner: Any = made(name)
        assert isinstance(learner, Learner)
        assert learner.config.centralised is centralised


def test_importing_the_names_imports_no_library() -> None:
    code = (
        "import sys, ugat_marl.experiments.transfers; "
        "sys.exit(bool({'stable_baselines3', 'torchrl', 'skrl', 'ray'} & {*sys.modules}))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.slow
def test_ugat_trains_a_baseline_and_takes_it_up_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    search_few_rules(monkeypatch, "largest-queue:20")
    found = transfer(IPPO, tmp_path / "whole")
    assert found.policies[:3] == ["direct transfer", "phase (the paper's UGAT)", "more plain sim"]
    assert found.notes["learner"] == "ippo"
    files = sorted(path.name for path in (tmp_path / "whole" / "policies").iterdir())
    assert files == ["direct-transfer.pt", "more-plain-sim.pt", "phase.pt"]
    for name in files:
        path = tmp_path / "whole" / "policies" / name
        assert NetworkPolicy.load(path).hidden == (16,)
        assert policy_factory(str(path))  # as evaluate reads it
    with pytest.raises(KeyboardInterrupt):
        transfer(IPPO, tmp_path / "broken", reporter=KillAt("grounded, iteration 2"))
    for other in ({"learner": "dqn", "learner_settings": ()}, {"learner_settings": ("hidden=8",)}):
        with pytest.raises(CheckpointError, match="another run"):
            transfer(replace(IPPO, **other), tmp_path / "broken", resume=True)
    transfer(IPPO, tmp_path / "broken", resume=True)
    for name in files:
        one, other = (
            NetworkPolicy.load(tmp_path / run / "policies" / name).parameters
            for run in ("whole", "broken")
        )
        assert np.array_equal(one, other), name
    direct, grounded = (
        NetworkPolicy.load(tmp_path / "whole" / "policies" / name).parameters for name in files[::2]
    )
    assert not np.array_equal(direct, grounded)
