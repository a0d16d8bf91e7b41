"""The matrix of learners and environments: what it calls good, and what it has to catch."""

from __future__ import annotations

import importlib.util
import re
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

from ugat_marl.errors import UnknownNameError
from ugat_marl.policies import BASELINES
from ugat_marl.policies.learners.catalogue import baselines_folder

FILE = baselines_folder() / "compat.py"
if not FILE.is_file():
    pytest.skip("baselines/ is neither here nor in the package", allow_module_level=True)


def load(path: Path, name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


compat = load(FILE, "baselines_compat")


class Careless:
    """Learns nothing, and shows what it likes."""

    def __init__(self, env: Any, action: int, episodes: int) -> None:
        self.agents, self.action, self.played = env.possible_agents, action, episodes

    def learn(self, env: Any, episodes: int, seed: int, on_episode: Any) -> Any:
        for number in range(self.played):
            env.reset(seed=number)
            while env.agents:
                env.step(dict.fromkeys(self.agents, self.action))
            on_episode(number, {"return": 0.0})
        return self

    def act(self, observations: Any, infos: Any) -> dict[str, int]:
        return dict.fromkeys(self.agents, self.action)


@pytest.mark.parametrize("column", ["equal", "unequal masks", "mixed-v1"])
def test_a_sound_learner_has_a_speed(column: str) -> None:
    assert compat.tried("ippo", column).endswith("/s")


@pytest.mark.parametrize(
    ("action", "episodes", "column", "says"),
    [
        (0, 3, "unequal masks", "forbidden phase 0"),
        (2, 3, "unequal", "tee_0"),  # which has two phases
        (0, 2, "equal", "2 episodes in the place of 3"),
        (0, 3, "equal", "/s"),
    ],
)
def test_a_careless_one_is_caught(
    action: int, episodes: int, column: str, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def factory(name: str) -> Any:
        return lambda env, seed: Careless(env, action, episodes)

    monkeypatch.setattr(compat, "learner_factory", factory)
    assert says in compat.tried("careless", column)


def test_what_crashes_or_hangs_is_a_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compat, "__file__", "/nowhere/compat.py")
    assert all("exit code 2" in text for text in compat.in_a_process("ippo").values())
    assert compat.short("exit code 2") == "fails" and compat.short("12/s") == "12"
    assert compat.short("learner needs x, which is not installed") == "-"
    monkeypatch.setattr(compat, "__file__", str(FILE))
    monkeypatch.setattr(compat, "PATIENCE_S", 0.01)
    assert all("no end within" in text for text in compat.in_a_process("ippo").values())


def test_an_unknown_learner_is_refused_before_anything_trains() -> None:
    with pytest.raises(UnknownNameError, match="ipo"):
        compat.Compat(learners=("ipo",))


def test_every_learner_of_a_library_is_an_extra_s() -> None:
    assert all(bool(item.extra) == bool(item.library) for item in BASELINES.values())


def test_every_learner_is_in_the_matrix() -> None:
    ci = FILE.parent.parent / ".ci" / "compat.py"
    if not ci.is_file():
        pytest.skip("a wheel has no .ci")
    learners = load(ci, "ci_compat").LEARNERS
    assert {name for names in learners.values() for name in names} == set(BASELINES)
    assert all(
        BASELINES[name].extra == extra for extra, names in learners.items() for name in names
    )


def test_the_versions_that_fit_together_are_pinned() -> None:
    root = FILE.parent.parent
    if not (root / "constraints-baselines.txt").is_file():
        pytest.skip("a wheel has no constraints")
    lines = (root / "constraints-baselines.txt").read_text().splitlines()
    pins = dict(line.lower().split("==") for line in lines if not line.startswith("#"))
    assert all(re.fullmatch(r"[\w.]+", version) for version in pins.values())
    extras = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    extras = extras["optional-dependencies"]
    for extra in {item.extra for item in BASELINES.values() if item.extra}:
        assert f"ugat-marl[{extra}" in str(extras["baselines"]) or f",{extra}" in str(
            extras["baselines"]
        )
        for requirement in extras[extra]:
            name = re.split(r"[\[>=]", requirement)[0]
            assert pins.keys() & {name, name.replace("-", "_")}, name
    assert pins["torch"] == "2.13.0"
