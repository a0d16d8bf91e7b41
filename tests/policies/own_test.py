"""Learners and policies of users: what they need, what is said when it is missing."""

from __future__ import annotations

import copy
import functools
import importlib
import json
import math
import os
import re
import subprocess
import sys
import threading
import zipfile
from collections import OrderedDict, deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import polars as pl
import pytest
import torch

import ugat_marl
from tests.interrupts import KillAfter
from tests.runs import search_few_rules
from ugat_marl.__main__ import main
from ugat_marl.data import Metrics
from ugat_marl.errors import ActionError, CheckpointError, OptionError, UnknownNameError
from ugat_marl.experiments import LearnerSpec, PaperConfig, policy_factory
from ugat_marl.policies import (
    OwnLearnerFactory,
    OwnPolicy,
    check_own_learner,
    is_own,
    load_own,
    own_name,
    own_policy,
    own_source,
    own_values,
)
from ugat_marl.policies.learner_settings import parsed_settings, setting_text
from ugat_marl.policies.own import OwnLearner
from ugat_marl.testing import ToyTraffic

ALGORITHM = '''
class Cycle:
    """Counts its episodes, and holds each phase for as many decisions."""

    def __init__(self, env, seed, first: int = 1):
        self.env, self.hold = env, first

    def learn(self, env, episodes):
        for _ in range(episodes):
            observations, infos = env.reset()
            while env.agents:
                actions = {agent: env.action_space(agent).sample() for agent in env.agents}
                observations, rewards, *_ = env.step(actions)
            self.hold += 1

    def policy(self):
        return Holding(self.hold)


class Holding:
    def __init__(self, hold):
        self.hold, self.decision = hold, 0

    def reset(self):
        self.decision = 0

    def act(self, observations):
        self.decision += 1
        return {agent: (self.decision // self.hold) % 2 for agent in observations}


class Kept(Cycle):
    def save(self, path):
        path.write_text(str(self.hold))

    def load(self, path):
        self.hold = int(path.read_text())


def first_phase(observations, infos):
    return dict.fromkeys(observations, 0)


def cycling(env):
    return Holding(2)


holding = Holding(3)
'''
SHORT = ("--duration-s", "100", "--evaluation-seeds", "1", "--tuning-seeds", "1")
FEW = ("--pretrain-episodes", "2", "--iterations", "1", "--grounded-episodes", "1")


@pytest.fixture
def algorithm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A module of a user in the working folder."""
    (tmp_path / "my_algo.py").write_text(ALGORITHM)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "my_algo", raising=False)
    module = importlib.import_module("my_algo")
    del sys.modules["my_algo"]
    monkeypatch.setitem(sys.modules, "my_algo", module)  # gone after the test: others use the name
    return module


def trained(folder: Path, learner: str, *words: str) -> int:
    """The exit code of a small training by the command line."""
    call = ["train", "single-v1", "--grounding", "phase", "--learner", learner]
    return main([*call, *SHORT, *FEW, "--out", str(folder), *words])


@pytest.mark.slow
@pytest.mark.usefixtures("algorithm")
def test_a_learner_with_two_methods_has_its_row_in_a_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    search_few_rules(monkeypatch, "programme")
    out = tmp_path / "table.csv"
    call = ["compare", "single-v1", "--name", "mine", "--learner", "my_algo:Cycle"]
    few = ["--seeds", "1", "--episodes", "2", "--domains", "V1", "--evaluation-seeds", "1"]
    where = ["--duration-s", "100", "--runs", str(tmp_path / "runs"), "--out", str(out)]
    assert main([*call, *few, *where]) == 0
    said = capsys.readouterr().out
    assert "mine" in said and "so the row stands alone" in said
    assert "mine" in out.read_text()


@pytest.mark.usefixtures("algorithm")
def test_rows_that_go_on_from_direct_transfer_need_a_learner_that_is_kept() -> None:
    with pytest.raises(OptionError, match="give its class the methods save"):
        PaperConfig(scenario=("single-v1",), learner="my_algo:Cycle")
    PaperConfig(scenario=("single-v1",), learner="my_algo:Kept")


@pytest.mark.usefixtures("algorithm")
def test_a_learner_with_two_methods_is_trained_and_judged_in_every_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    search_few_rules(monkeypatch, "programme")
    assert trained(tmp_path / "run", "my_algo:Cycle") == 0
    out = capsys.readouterr().out
    assert "my_algo:Cycle has no save(path) and load(path)" in out
    table = json.loads((tmp_path / "run" / "table.json").read_text())
    names = [row["policy"] for row in table["summary"] if row["domain"] == "V4"]
    assert names[:3] == ["direct transfer", "phase (the paper's UGAT)", "more plain sim"]
    rows = Metrics.read(tmp_path / "run" / "metrics.parquet").rows
    assert sorted(step for _, step, name, _ in rows if name == "return") == [0, 1, 2]
    assert not list((tmp_path / "run" / "policies").glob("*"))


@pytest.mark.slow
@pytest.mark.usefixtures("algorithm")
def test_the_command_says_how_files_of_a_learner_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    search_few_rules(monkeypatch, "programme")
    assert trained(tmp_path / "run", "my_algo:Kept", "--learner-settings", "first=2") == 0
    out = " ".join(capsys.readouterr().out.split())
    assert out.endswith("Other commands take a file there as my_algo:Kept@FILE.")


@pytest.mark.slow
@pytest.mark.usefixtures("algorithm")
def test_a_learner_that_can_be_saved_resumes_to_the_numbers_of_an_unbroken_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    search_few_rules(monkeypatch, "programme")
    common: dict[str, Any] = {
        "learner": "my_algo:Kept", "learner_settings": ["first=2"], "grounding": "phase",
        "pretrain_episodes": 2, "iterations": 2, "grounded_episodes": 1, "duration_s": 100.0,
        "evaluation_seeds": 1,
    }  # fmt: skip
    whole = ugat_marl.train("single-v1", out=tmp_path / "whole", **common)
    stop = KillAfter("grounded, iteration 2", 0)
    with pytest.raises(KeyboardInterrupt):
        ugat_marl.train("single-v1", out=tmp_path / "cut", reporter=stop, **common)
    again = ugat_marl.train("single-v1", out=tmp_path / "cut", resume=True, **common)
    assert again.table.equals(whole.table)
    assert set(again.policies) == {"direct-transfer", "phase", "more-plain-sim"}
    direct = again.policies["direct-transfer"]
    played = ugat_marl.evaluate(
        "single-v1", f"my_algo:Kept@{direct}", ["sim"], seeds=1, duration_s=100.0
    )
    expected = whole.table.filter(pl.col("policy") == "direct transfer", pl.col("domain") == "sim")
    assert played["att_s"].item() == expected["att_s"].item()


def test_a_learner_of_a_notebook_is_given_as_an_object(
    tmp_path: Path, algorithm: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    search_few_rules(monkeypatch, "programme")
    run = ugat_marl.train(
        "single-v1",
        learner=lambda env, seed: algorithm.Cycle(env, seed, first=4),
        grounding="phase",
        pretrain_episodes=1,
        iterations=0,
        control=False,
        evaluation_seeds=1,
        duration_s=100.0,
        out=tmp_path / "run",
    )
    table = run.table
    assert table.columns[:4] == ["policy", "domain", "episodes", "att_s"]
    assert set(table["domain"]) == {"sim", "V4"}
    assert str(run.folder) in repr(run)


def test_policies_of_every_form_are_evaluated(algorithm: Any) -> None:
    table = ugat_marl.evaluate(
        "single-v1",
        {
            "object": algorithm.Holding(3),
            "same": "my_algo:holding",
            "function": algorithm.first_phase,
            "maker": algorithm.cycling,
            "rule": "fixed-time:30",
        },
        ["sim", "V4"],
        seeds=2,
        duration_s=200.0,
    )
    att = {(row["policy"], row["domain"]): row["att_s"] for row in table.to_dicts()}
    assert len(att) == 10 and table["episodes"].to_list() == [2] * 10
    assert att["object", "sim"] == att["same", "sim"]
    assert att["object", "sim"] != att["maker", "sim"]
    best = min(value for (_, domain), value in att.items() if domain == "V4")
    for row in table.to_dicts():
        if row["domain"] == "V4":
            assert row["regret_s"] == pytest.approx(row["att_s"] - best)
            assert row["gap_s"] == pytest.approx(row["att_s"] - att[row["policy"], "sim"])
    each = ugat_marl.evaluate(
        "single-v1", algorithm.holding, ["sim"], seeds=[7], duration_s=200.0, each_episode=True
    )
    assert each.select("policy", "seed").rows() == [("Holding", 7)]


class Noted:
    """A learner that can be saved."""

    def learn(self, env: Any, episodes: int) -> None: ...

    def policy(self) -> Any:
        return lambda observations: dict.fromkeys(observations, 0)

    def save(self, path: Path) -> None:
        path.write_text("noted")

    def load(self, path: Path) -> None:
        assert path.read_text() == "noted"


def test_what_sees_through_a_function_can_be_played_and_not_saved(tmp_path: Path) -> None:
    env = ugat_marl.parallel_env("single-v1", observation=lambda _: [1.0, 2.0])
    learner = OwnLearner(Noted(), "noted", env)
    assert learner.policy().act({"a": 0}, {}) == {"a": 0}
    assert not learner.policy().savable
    with pytest.raises(CheckpointError, match="keep to plain data"):
        learner.save(tmp_path / "learner.zip")


def test_a_state_is_not_loaded_where_observations_are_others(tmp_path: Path) -> None:
    for observation in ("count", "queue"):
        env = ugat_marl.parallel_env("single-v1", observation=observation)
        learner = OwnLearner(Noted(), "noted", env)
        if observation == "count":
            learner.save(tmp_path / "learner.zip")
            learner.load(tmp_path / "learner.zip")
    with pytest.raises(CheckpointError, match="observation = 'count', not 'queue'"):
        learner.load(tmp_path / "learner.zip")


def test_infos_may_be_an_argument_by_name_alone() -> None:
    env = ToyTraffic()
    observations, infos = env.reset(seed=0)

    def given(observations: Any, *, infos: Any = None) -> Any:
        return dict.fromkeys(observations, int(infos is None))

    def needed(observations: Any, *, infos: Any) -> Any:
        return given(observations, infos=infos)

    def of_one(observations: Any, *, info: Any = None) -> Any:
        return given(observations, infos=info)

    for act in (given, needed, of_one):
        assert set(own_policy(act, "mine", env).act(observations, infos).values()) == {0}


def test_a_policy_that_asks_for_masks_is_told_where_they_are() -> None:
    def ranked(observations: Any, mask: Any = None) -> Any: ...

    def named(observations: Any, *, action_mask: Any = None) -> Any: ...

    for act in (ranked, named):
        with pytest.warns(UserWarning, match=r"mask' is never given; take the infos"):
            OwnPolicy(act, "mine", {})

    def of_its_own(observations: Any, infos: Any, mask: Any = None) -> Any:
        return dict.fromkeys(observations, int(mask is not None))

    assert OwnPolicy(of_its_own, "mine", {}).act({"a": [1]}, {}) == {"a": 0}


def test_infos_may_hold_no_masks_and_more_than_the_agents() -> None:
    """The kit allows both."""
    policy = OwnPolicy(lambda observations: dict.fromkeys(observations, 2), "mine", {})
    assert policy.act({"a": [1]}, {"__common__": {"time_s": 1.0}, "a": {}}) == {"a": 2}
    seen = {"a": [1], "b": [1]}
    with pytest.raises(OptionError, match="'mine' returned a phase for 'foo'; agents: a, b"):
        OwnPolicy(lambda _: {"a": 0, "b": 0, "foo": 0}, "mine", {}).act(seen, {})
    with pytest.raises(OptionError, match="no phase for 'b'"):
        OwnPolicy(lambda observations: {"a": 0}, "mine", {}).act({"a": [1], "b": [1]}, {})


def test_an_option_of_a_policy_does_not_get_the_infos() -> None:
    def plain(observations: Any, deterministic: bool = True) -> Any:
        return dict.fromkeys(observations, int(deterministic is not True))

    def asks(observations: Any, infos: Any = None) -> Any:
        return dict.fromkeys(observations, int(infos is None))

    def asks_for_one(observations: Any, info: Any = None) -> Any:
        return asks(observations, info)

    for act in (plain, asks, asks_for_one):
        assert OwnPolicy(act, "mine", {}).act({"a": [1]}, {"a": {"action_mask": [1]}}) == {"a": 0}


def test_a_policy_of_the_command_line(
    algorithm: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    words = ["--policies", "my_algo:first_phase", "fixed-time:30", "--domains", "sim"]
    assert main(["evaluate", "single-v1", *words, "--seeds", "1", "--duration-s", "100"]) == 0
    assert "my_algo:first_phase" in capsys.readouterr().out


class NoPolicy:
    def learn(self, env: Any, episodes: int) -> None:
        """Learn nothing."""


class NeedsMore(NoPolicy):
    def learn(self, env: Any, episodes: int, buffer: Any) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Ask for more than is given."""

    def policy(self) -> Any:
        return lambda observations: dict.fromkeys(observations, 0)


class Lazy(NoPolicy):
    def policy(self) -> Any:
        return lambda observations: dict.fromkeys(observations, 0)


class Wild(Lazy):
    def policy(self) -> Any:
        return lambda observations: dict.fromkeys(observations, 99)


class Mute(Lazy):
    def policy(self) -> Any:
        return lambda observations: None


class Unready(Lazy):
    def policy(self) -> Any:
        raise RuntimeError("no network yet")


class Bare(Lazy):
    def policy(self) -> Any:
        return 3


@pytest.mark.parametrize(
    ("learner", "error", "says"),
    [
        (NoPolicy, OptionError, "no method policy()"),
        (NeedsMore, OptionError, "called as learn(env, episodes)"),
        (Wild, OptionError, "its phases are 0 to"),
        (Mute, OptionError, "returned NoneType"),
        (Unready, OptionError, "no network yet"),
        (Bare, OptionError, "a int has no act"),
        (Lazy(), OptionError, "give its class"),
        (3, OptionError, "is of the kind int"),
    ],
)
def test_what_a_learner_lacks_is_said_before_the_first_episode(
    learner: Any, error: type[Exception], says: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=re.escape(says)):
        ugat_marl.train(
            "single-v1", learner=learner, grounding="phase", duration_s=100.0, out=tmp_path / "run"
        )
    assert not (tmp_path / "run").exists()


def test_a_learner_that_plays_too_little_is_refused() -> None:
    learner = check_own_learner(OwnLearnerFactory(own_name(Lazy)), ToyTraffic(), 0)
    with pytest.raises(OptionError, match=r"learn\(env, 2\) played 0 whole episodes"):
        learner.learn(ToyTraffic(), 2, 0)


def test_later_learning_does_not_change_a_policy(algorithm: Any) -> None:
    env = ToyTraffic()
    learner = OwnLearnerFactory(own_name(algorithm.Kept))(env, 0)
    before = learner.policy()
    learner.learn(env, 3, 0)
    observations, infos = env.reset(seed=0)
    for policy, changes_at in ((before, 1), (learner.policy(), 4)):
        policy.reset(0)
        shown = [set(policy.act(observations, infos).values()) for _ in range(5)]
        assert shown.index({1}) + 1 == changes_at


class OwnPlayer(Noted):
    """A learner that keeps the environment it is made for, and is its own policy."""

    def __init__(self, env: Any) -> None:
        self.env = env

    def learn(self, env: Any, episodes: int) -> None:
        for _ in range(episodes):
            env.reset()
            while env.agents:
                env.step(dict.fromkeys(env.agents, 0))

    def policy(self) -> Any:
        return self.act

    def act(self, observations: Any) -> Any:
        return dict.fromkeys(observations, 0)


def test_a_policy_keeps_the_environment_of_its_learner_after_learning_in_another() -> None:
    env = ToyTraffic()
    learner = OwnLearner(OwnPlayer(env), "own player", env)
    for policy in (learner.policy(), learner.learn(ToyTraffic(), 1, 0), learner.policy()):
        assert copy.deepcopy(policy)._given.__self__.env is env


class Closing:
    """A learner whose policy is a function with the learner in its closure."""

    def __init__(self, rate: float = 0.5, double: Any = True) -> None:
        self.rate, self.double, self.learnt = rate, double, 0

    def learn(self, env: Any, episodes: int) -> None:
        for _ in range(episodes):
            env.reset()
            while env.agents:
                env.step(dict.fromkeys(env.agents, 0))
            self.learnt += 1

    def policy(self) -> Any:
        def chosen(observations: Any, table: list[int] = [self.learnt]) -> Any:  # noqa: B006
            assert table == [self.learnt]
            return dict.fromkeys(observations, self.learnt % 2)

        return lambda observations: chosen(observations)


class Holder:
    """A policy that asks a function it holds, as many layers down as it is told."""

    def __init__(self, choose: Any, layers: int = 1) -> None:
        self.choose = Holder(choose, layers - 1).act if layers > 1 else choose

    def act(self, observations: Any) -> Any:
        return self.choose(observations)


class ClosingPartly(Closing):
    def policy(self) -> Any:
        chosen = super().policy()
        return functools.partial(lambda add, observations: chosen(observations), 1)


class ClosingInside(Closing):
    def policy(self) -> Any:
        return Holder(super().policy(), layers=2)


class WithSlot:
    __slots__ = ("act",)


class Derived(WithSlot):
    __slots__ = ()

    def __init__(self, act: Any) -> None:
        self.act = act


class ClosingInSlots(Closing):
    def policy(self) -> Any:
        return Derived(super().policy())


class ClosingInADeque(Closing):
    def policy(self) -> Any:
        kept = deque([super().policy()])
        return functools.partial(lambda held, observations: held[0](observations), kept)


@pytest.mark.parametrize(
    "kind", [Closing, ClosingPartly, ClosingInside, ClosingInSlots, ClosingInADeque]
)
def test_later_learning_does_not_change_a_policy_that_is_a_function(kind: Any) -> None:
    env = ToyTraffic()
    learner = OwnLearnerFactory(own_name(kind))(env, 0)
    before = learner.policy()
    after = learner.learn(env, 1, 0)
    observations, infos = env.reset(seed=0)
    for policy, phase in ((before, 0), (after, 1), (copy.deepcopy(before), 0)):
        assert set(policy.act(observations, infos).values()) == {phase}


def test_functions_of_modules_and_those_with_locks_stay_what_they_are() -> None:
    lock = threading.Lock()

    def locked(observations: Any) -> Any:
        with lock:
            return dict.fromkeys(observations, 0)

    policy = OwnPolicy(Holder(locked), "locked", {})
    policy._given.relu = torch.nn.functional.relu
    made = copy.deepcopy(policy)
    observations, infos = ToyTraffic().reset(seed=0)
    assert set(made.act(observations, infos).values()) == {0}
    assert made._given.relu is torch.nn.functional.relu


def test_what_a_class_of_a_function_holds_is_part_of_its_identity() -> None:
    def made(phase: int, table: Any = None) -> type:
        class Learner:
            spread = table

            def policy(self) -> Any:
                return lambda observations: dict.fromkeys(observations, phase)

        return Learner

    kinds = [made(1), made(1), made(3), made(1, table=2)]
    first, same, other, also_other = (own_values(own_name(kind)) for kind in kinds)
    assert first == same and other not in (first, also_other) and also_other != first


@dataclass
class Settings:
    weights: Any


@dataclass(slots=True)
class Slotted:
    weights: Any


@pytest.mark.parametrize(
    "hold",
    [
        lambda array: array,
        Settings,
        torch.from_numpy,
        lambda array: OrderedDict(start=array),
        lambda array: SimpleNamespace(start=array),
        lambda array: pl.DataFrame({"start": array}),
        lambda array: deque([array]),
        Slotted,
    ],
    ids=["array", "dataclass", "tensor", "mapping", "namespace", "table", "deque", "slots"],
)
def test_long_arrays_are_a_part_of_an_identity_whatever_holds_them(hold: Any) -> None:
    """Their middle is left out of their `repr`."""

    def identity(middle: float) -> object:
        array = np.zeros(5000)
        array[2500] = middle
        return own_values(own_name(functools.partial(Settings, hold(array))))

    assert identity(0.0) == identity(0.0) != identity(1.0)


def test_defaults_and_closures_of_a_function_are_a_part_of_its_identity() -> None:
    def made(phase: int, late: bool = False) -> Any:
        def act(observations: Any, *, chosen: int = phase) -> Any:
            return dict.fromkeys(observations, chosen + offset)

        if not late:
            offset = 0
        held = own_values(own_name(act))  # where late, while `offset` has no value
        offset = 0
        return held

    assert made(0) == made(0) != made(1)
    assert made(0, late=True) != made(0)


def test_an_object_with_slots_is_known_by_them() -> None:
    assert own_values(own_name(Slotted(1))) == own_values(own_name(Slotted(1)))
    assert own_values(own_name(Slotted(1))) != own_values(own_name(Slotted(2)))


def test_what_is_typed_in_a_notebook_is_known_by_its_code() -> None:
    def hash_of(phase: int, lines: int = 0) -> str | None:
        space: dict[str, Any] = {"__name__": "__main__"}
        code = (
            f"class Typed:\n def policy(self):\n  return lambda seen: dict.fromkeys(seen, {phase})"
        )
        exec("\n" * lines + code, space)
        space["Typed"].__module__ = "a notebook"
        return own_source(own_name(space["Typed"]))

    assert hash_of(0) is not None
    assert hash_of(0) == hash_of(0, lines=3) != hash_of(7)


@pytest.mark.parametrize(
    "code",
    [
        "class Typed(Base):\n rate = {}",
        "class Typed(Base):\n def __init__(self, env, lr={}): pass",
        "class Typed(Base):\n def __init__(self, env, *, lr={}): pass",
        "class Typed(Base):\n rate = property(lambda self: {})",
        "class Typed(Base):\n class Net:\n  width = {}",
        "Base.phase = {}\nclass Typed(Base): pass",
        "class Other(Base):\n def policy(self): return {}\nclass Typed(Other): pass",
        "def Typed(env, lr={}): return Base()",
        "def wrapped(make):\n return functools.wraps(make)(lambda env: make(env))\n"
        "@wrapped\ndef Typed(env): return {}",
        "class Net:\n width = {}\nTyped = functools.partial(Base, Net())",
    ],
)
def test_all_that_is_typed_in_a_notebook_is_a_part_of_its_identity(code: str) -> None:
    def identity(value: int) -> object:
        space: dict[str, Any] = {"__name__": "notebook", "functools": functools}
        typed = "class Base:\n def policy(self): return None\n"
        exec(typed + code.replace("{}", str(value)), space)
        return LearnerSpec(own_name(space["Typed"])).identity

    assert identity(1) == identity(1) != identity(2)


def test_a_learner_whose_file_was_edited_after_its_import_begins_no_training(
    algorithm: Any, tmp_path: Path
) -> None:
    file, names = tmp_path / "my_algo.py", ("my_algo:Kept", "my_algo.py:Cycle")
    run, *_ = [LearnerSpec(name) for name in names]
    source = run.identity["source"]
    file.write_text(ALGORITHM.replace("self.hold += 1", "self.hold += 2"))
    for name in names:
        with pytest.raises(OptionError, match=r"my_algo\.py was changed .*; restart Python"):
            LearnerSpec(name)
    run.factory()
    assert run.identity["source"] == source  # of what a run trains that has begun
    importlib.reload(algorithm)
    assert LearnerSpec("my_algo:Kept").identity["source"] != source
    file.write_text(ALGORITHM)
    with pytest.raises(OptionError, match="restart Python"):
        LearnerSpec(own_name(algorithm.Kept))


def test_an_object_that_was_given_leaves_its_class_its_name(algorithm: Any) -> None:
    given = algorithm.Kept(ugat_marl.parallel_env("single-v1"), 0)
    with pytest.raises(OptionError, match="is one learner already"):
        OwnLearnerFactory(own_name(given))
    assert OwnLearnerFactory("my_algo:Kept").name == "my_algo:Kept"


def test_a_learner_whose_save_writes_nothing_is_told_so(algorithm: Any) -> None:
    class Silent(algorithm.Kept):  # type: ignore[misc]
        def save(self, path: Path) -> None: ...

    env = ugat_marl.parallel_env("single-v1")
    learner = OwnLearner(Silent(env, 0), "my_algo:Silent", env)
    with pytest.raises(OptionError, match=r"save\(path\) wrote nothing"):
        learner.policy()


def test_a_script_that_is_run_again_in_the_same_python_is_another_learner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Consoles run an edited script within the module that is there."""
    script, module = tmp_path / "script.py", ModuleType("console")
    module.__file__ = str(script)
    monkeypatch.setitem(sys.modules, "console", module)

    def run(hold: int) -> str:
        script.write_text(ALGORITHM.replace("self.hold += 1", f"self.hold += {hold}"))
        exec(compile(script.read_text(), str(script), "exec"), vars(module))
        return str(LearnerSpec(own_name(module.Kept)).identity["source"])

    assert run(1) != run(2)


def test_an_environment_that_a_learner_holds_is_known_by_what_it_is_made_of() -> None:
    """Not by where it is in an episode, which differs at each start."""

    def values_of(domain: str) -> list[list[str]]:
        env = ugat_marl.parallel_env("single-v1", domain, duration_s=100)

        def policy(observations: Any) -> dict[str, int]:
            return dict.fromkeys(env.possible_agents, len(observations))

        found = [own_values(own_name(policy))]
        for seed in (1, 2):
            env.reset(seed=seed)
            found.append(own_values(own_name(policy)))
        env.close()
        return [*found, own_values(own_name(policy))]

    one, other = values_of("sim"), values_of("V4")
    assert all(values == one[0] for values in one)
    assert one[0] != other[0]


@pytest.mark.parametrize(
    ("hint", "text", "value"),
    [
        (list[int], "8,8", [8, 8]),
        (list[int], "[8, 8]", [8, 8]),
        (Sequence[float], "0.5", [0.5]),
        (tuple[int, ...], "8,4", (8, 4)),
        (str, "none", "none"),
        (str | None, "None", None),
        (list[str], "['a', 'b']", ["a", "b"]),
        (list[str], "a,b", ["a", "b"]),
        (list[str], "queue", ["queue"]),
        (tuple[str, ...], "queue", ("queue",)),
        (Sequence[str], "queue", ["queue"]),
        (str, "5", "5"),
        (str, "'abc'", "'abc'"),
        (int | list[int], "5", 5),
        (float | str, "0.5", 0.5),
        (float | str, "auto", "auto"),
        (int | str, "5", 5),
        (str | list[str], "adam", "adam"),
        (list[str] | str, "adam,sgd", ["adam", "sgd"]),
        (tuple[int, ...] | None, "8", (8,)),
        (np.float32, "0.25", 0.25),
        (np.ndarray, "[1, 2]", [1, 2]),
        (bool, "TRUE", True),
        (int | bool, "true", True),
        (int, "1", 1),
    ],
)
def test_settings_come_in_the_forms_of_their_types(hint: Any, text: str, value: Any) -> None:
    assert parsed_settings([f"x={text}"], ["x"], {"x": hint}, "mine") == {"x": value}


@pytest.mark.parametrize(
    ("hint", "value", "text"),
    [
        (Any, 0.1, "0.1"),
        (Any, (8, 16), "8,16"),
        (Any, [8, 16], "[8, 16]"),
        (Any, (32,), "(32,)"),
        (Any, (), "()"),
        (Any, ["a", "b"], "['a', 'b']"),
        (Any, "12", "'12'"),
        (Any, "adam", "adam"),
        (Any, {"a": 1}, "{'a': 1}"),
        (str, "12", "12"),
        (list[int], [8, 16], "8,16"),
        (tuple[int, ...], (32,), "32"),
        (tuple[int, ...], (), "()"),
        (tuple[str, ...], ("a,b", "c"), "('a,b', 'c')"),
        (Path, Path("a"), "a"),
    ],
)
def test_values_of_python_arrive_as_they_are(hint: Any, value: Any, text: str) -> None:
    assert setting_text("x", value, hint) == f"x={text}"
    (read,) = parsed_settings([f"x={text}"], ["x"], {"x": hint}, "mine").values()
    assert read == value and type(read) is type(value)


@pytest.mark.parametrize(
    ("hint", "value", "text"),
    [
        (Any, np.float64(0.1), "0.1"),
        (Any, (np.int64(64), np.int64(32)), "64,32"),
        (list[float], [np.float64(0.1), np.float64(0.2)], "0.1,0.2"),
        (dict[str, float], {"rate": np.float64(0.1)}, "{'rate': 0.1}"),
        (float, math.nan, "nan"),
        (tuple[int, ...], [32], "32"),
        (np.ndarray, np.array([1, 2]), "[1, 2]"),
    ],
)
def test_values_arrive_in_the_type_of_the_setting(hint: Any, value: Any, text: str) -> None:
    assert setting_text("x", value, hint) == f"x={text}"


@pytest.mark.parametrize(
    ("hint", "value"), [(Any, object()), (Any, math.nan), (float | str, "0.5"), (str, "")]
)
def test_a_value_that_no_text_says_is_refused(hint: Any, value: Any) -> None:
    with pytest.raises(OptionError, match=r"setting x = .*: a run keeps settings as text"):
        setting_text("x", value, hint)


def test_a_value_of_another_type_is_refused_as_its_text_is() -> None:
    with pytest.raises(OptionError, match="'x=fast': .*valid number"):
        parsed_settings([setting_text("x", "fast", float)], ["x"], {"x": float}, "mine")


@pytest.mark.parametrize(
    ("hint", "text", "says"),
    [
        (int, "true", "valid integer"),
        (float, "False", "valid number"),
        (int | None, "true", "valid integer"),
        (tuple[int, ...], "64.5", "valid integer"),
        (tuple[int, ...], "64,wide", "valid integer"),
        (list[float], "{}", "valid number"),
    ],
)
def test_settings_of_another_type_are_refused(hint: Any, text: str, says: str) -> None:
    with pytest.raises(OptionError, match=f"'x={text}': .*{says}"):
        parsed_settings([f"x={text}"], ["x"], {"x": hint}, "mine")


def test_a_setting_is_given_once() -> None:
    for other in ("gae_lambda=0.5", "gae-lambda=0.9"):
        with pytest.raises(OptionError, match="gae_lambda is given twice"):
            parsed_settings(["gae_lambda=0.9", other], ["gae_lambda"], {}, "mine")


@pytest.mark.parametrize("text", ["{[1]:2}", "-" * 20_000 + "1", "some words"])
def test_words_that_are_no_literal_stay_words(text: str) -> None:
    assert parsed_settings([f"x={text}"], ["x"], {}, "mine") == {"x": text}


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ({"observation": "movements", "duration_s": 50}, "hold 'duration_s', which the evaluation"),
        ({"domain": "V4"}, "hold 'domain'"),
        ({"reward": "pressure"}, "a policy may ask for observation, neighbours, commands, signals"),
        ("count", "its env_options are a str"),
    ],
)
def test_a_policy_does_not_decide_how_it_is_judged(asked: object, says: str) -> None:
    def still(observations: Any) -> dict[str, int]:
        return dict.fromkeys(observations, 0)

    still.env_options = asked  # type: ignore[attr-defined]
    with pytest.raises(OptionError, match=re.escape(says)):
        ugat_marl.evaluate("single-v1", still, ["sim"], seeds=1, duration_s=100)


@pytest.mark.parametrize(
    "action", [np.array([1, 2]), torch.tensor([1, 2]), "0x", None, math.nan, math.inf, 0.5]
)
def test_a_wrong_action_is_named_with_its_agent(action: Any) -> None:
    policy = OwnPolicy(lambda _: {"a": 0, "b": action}, "mine", {})
    with pytest.raises(
        OptionError, match=r"policy 'mine' returned .* for 'b'; it must be the number"
    ):
        policy.act({}, {})


def test_a_maker_with_some_arguments_filled_in_makes_a_policy() -> None:
    def make(env: Any, phase: int) -> Any:
        assert env.possible_agents
        return lambda observations: dict.fromkeys(observations, phase)

    toy = ToyTraffic()
    policy = own_policy(functools.partial(make, phase=1), "made", toy)
    assert policy.act({"a": np.zeros(1)}, {}) == {"a": 1}


def test_the_identity_of_captured_objects_is_the_same_in_every_process(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        "import functools\n"
        "import numpy as np\n"
        "from ugat_marl.policies.own_names import own_name, own_values\n"
        "class Net:\n"
        "    def __init__(self, n):\n"
        "        self.n, self.me = n, self\n"
        "def helper(): pass\n"
        "def made(n):\n"
        "    net, kinds, table = Net(n), {'left', 'right', 'through'}, np.arange(n * 5000)\n"
        "    def make(env, seed):\n"
        "        return net, kinds, table, helper, make\n"
        "    return make\n"
        "for n in (1, 1, 2):\n"
        "    print(own_values(own_name(functools.partial(made(n), rate=helper))))\n"
    )
    printed = [
        subprocess.run(
            [sys.executable, "mine.py"], cwd=tmp_path, check=True, capture_output=True, text=True,
            env={**os.environ, "PYTHONHASHSEED": seed},
        ).stdout.splitlines()
        for seed in ("1", "2")
    ]  # fmt: skip
    assert printed[0] == printed[1]
    assert printed[0][0] == printed[0][1] != printed[0][2]
    assert " at 0x" not in printed[0][0]


def test_settings_without_usable_types_are_literals() -> None:
    for text in ("false", "False"):
        learner: Any = OwnLearnerFactory(own_name(Closing), [f"double={text}"])(ToyTraffic(), 0)
        assert learner._given.double is False

    def make(env: Absent, rate: float = 0.5) -> Any:  # type: ignore[name-defined]  # noqa: F821
        return Closing(rate)

    learner = OwnLearnerFactory(own_name(make), ["rate=0.2"])(ToyTraffic(), 0)
    assert learner._given.rate == 0.2
    with pytest.raises(OptionError, match="number"):
        OwnLearnerFactory(own_name(make), ["rate=high"])


def test_a_class_of_policies_is_made_for_the_environment_it_asks_for() -> None:
    class Sized:
        env_options: ClassVar[dict[str, Any]] = {"observation": "movements"}

        def __init__(self, env: Any) -> None:
            self.sizes = {agent: env.observation_space(agent).shape for agent in env.agents}
            self.names = env.possible_agents
            self.shapes = {agent: env.observation_space(agent).shape for agent in self.names}

        def act(self, observations: Any) -> Any:
            assert all(observations[x].shape == self.shapes[x] for x in observations)
            return dict.fromkeys(observations, 0)

    table = ugat_marl.evaluate("single-v1", {"sized": Sized}, ["sim"], seeds=1, duration_s=60)
    assert table.height == 1


def test_a_training_with_the_same_seed_is_the_same(algorithm: Any) -> None:
    seen: list[list[float]] = []
    for _ in range(2):
        learner = OwnLearnerFactory("my_algo:Cycle")(ToyTraffic(), 0)
        seeds: list[float] = []
        env = ToyTraffic()
        reset = env.reset

        def noted(
            seed: int | None = None,
            options: Any = None,
            reset: Any = reset,
            seeds: Any = seeds,
        ) -> Any:
            seeds.append(float(seed or -1))
            return reset(seed=seed, options=options)

        env.reset = noted
        learner.learn(env, 2, 5)
        learner.learn(env, 1, 5)
        seen.append(seeds)
    assert seen[0] == seen[1]
    assert len(set(seen[0])) == 3 and -1.0 not in seen[0]


def test_files_of_one_name_in_two_folders_are_two_modules(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])
    for number in (1, 2):
        (tmp_path / str(number)).mkdir()
        (tmp_path / str(number) / "twice.py").write_text(
            f"def policy(observations): return {number}"
        )
    found = [load_own(f"{tmp_path}/{number}/twice.py:policy", "policy") for number in (1, 2)]
    assert [policy({}) for policy in found] == [1, 2]
    assert load_own(f"{tmp_path}/1/twice.py:policy", "policy") is found[0]
    with pytest.raises(OptionError, match=r"no file .*3/twice\.py"):
        load_own(f"{tmp_path}/3/twice.py:policy", "policy")


@pytest.mark.parametrize("folder", ["my folder", "a+b (1)", "with~tilde", "c:d"])
def test_a_file_may_lie_in_a_folder_of_any_name(
    folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / folder).mkdir()
    (tmp_path / folder / "algo.py").write_text(ALGORITHM)
    for place in (str(tmp_path / folder), f"~/{folder}"):
        policy_factory(f"{place}/algo.py:first_phase")
        assert OwnLearnerFactory(LearnerSpec(f"{place}/algo.py:Kept").name).name.startswith(place)


@pytest.mark.parametrize("name", [r"C:\Users\me and you\algo.py:Kept", "x.py:Kept.Inner"])
def test_a_path_and_a_name_in_it_are_a_name(name: str) -> None:
    assert is_own(name)


@pytest.mark.parametrize("name", ["max-pressure:20", "my folder:Kept", "algo.py", "algo.py:", ""])
def test_what_names_no_object_is_no_name(name: str) -> None:
    assert not is_own(name)


@pytest.mark.usefixtures("algorithm")
@pytest.mark.parametrize(
    ("name", "error", "says"),
    [
        ("my_aglo:Cycle", OptionError, "no module 'my_aglo'"),
        (
            "./my_algo:Cycle",
            OptionError,
            r"'./my_algo'; give the file as my_algo.py:Cycle",
        ),
        (".my_algo:Cycle", OptionError, "no module '.my_algo'"),
        ("numpy.foo:Cycle", OptionError, "no module 'numpy.foo'"),
        ("my_algo:Cylce", UnknownNameError, "'Cycle'"),
        ("my_algo.py:Cylce", UnknownNameError, "'Cycle'"),
    ],
)
def test_a_name_that_leads_nowhere_is_refused(name: str, error: type[Exception], says: str) -> None:
    with pytest.raises(error, match=says):
        load_own(name, "learner")


def test_a_file_that_is_no_python_is_refused_in_a_line(tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text("def policy(:\n    pass\n")
    with pytest.raises(OptionError, match=r"broken\.py, line 1 is no Python \(invalid syntax\)"):
        load_own(f"{tmp_path}/broken.py:policy", "policy")


def test_a_file_that_imports_a_missing_name_is_refused_in_a_line(tmp_path: Path) -> None:
    (tmp_path / "astray.py").write_text("import math\nfrom math import no_such_name\n")
    says = r"astray\.py, line 2: ImportError: cannot import name .*name'[^\n]*$"
    with pytest.raises(OptionError, match=says):
        load_own(f"{tmp_path}/astray.py:policy", "policy")


def test_an_error_in_the_file_of_a_policy_is_told_with_its_place(tmp_path: Path) -> None:
    (tmp_path / "failing.py").write_text("rate = 1\nrate / 0\n")
    says = r"^policy '.*': .*failing\.py, line 2: ZeroDivisionError: division by zero$"
    with pytest.raises(OptionError, match=says):
        load_own(f"{tmp_path}/failing.py:policy", "policy")
    (tmp_path / "reading.py").write_text("import json\njson.loads('{')\n")
    with pytest.raises(OptionError, match=r"reading\.py, line 2: JSONDecodeError: "):
        load_own(f"{tmp_path}/reading.py:policy", "policy")


class Unmade:
    def __init__(self) -> None:
        raise KeyError("rate")


def unmade(env: Any) -> Any:
    return Unmade()


@pytest.mark.parametrize("given", [Unmade, unmade, functools.partial(unmade)])
def test_an_error_while_a_policy_is_made_is_told_with_its_place(given: Any) -> None:
    says = r"^policy 'mine': KeyError: 'rate'.*own_test\.py, line \d+\)?$"
    with pytest.raises(OptionError, match=says):
        own_policy(given, "mine", ToyTraffic())


def test_a_function_without_a_name_has_one() -> None:
    made = lambda env, seed: env  # noqa: E731 - as a notebook's first cell has it
    made.__qualname__ = "<lambda>"
    assert is_own(own_name(made))


@pytest.mark.usefixtures("algorithm")
def test_settings_have_the_type_of_the_argument() -> None:
    learner: Any = OwnLearnerFactory("my_algo:Cycle", ["first=6"])(ToyTraffic(), 0)
    assert learner.policy()._given.hold == 6
    with pytest.raises(OptionError, match="integer"):
        OwnLearnerFactory("my_algo:Cycle", ["first=many"])
    with pytest.raises(UnknownNameError, match="first"):
        OwnLearnerFactory("my_algo:Cycle", ["frist=2"])


def test_an_argument_without_a_default_is_asked_for() -> None:
    class Tuned(NoPolicy):
        def __init__(self, env: Any, rate: float, *, depth: int, width: int = 3) -> None: ...

        def policy(self) -> Any: ...

    name = own_name(Tuned)
    with pytest.raises(OptionError, match=r"needs rate and depth; .* rate=VALUE depth=VALUE, or"):
        OwnLearnerFactory(name)(ToyTraffic(), 0)
    OwnLearnerFactory(name, ["rate=0.1", "depth=2"])(ToyTraffic(), 0)


@pytest.mark.parametrize("policy", [lambda o, i, extra: {}, lambda *, observations: {}])
def test_a_policy_that_cannot_be_called_is_refused_before_it_plays(policy: Any) -> None:
    with pytest.raises(OptionError, match=r"takes \(.*\), and is called with the observations"):
        own_policy(policy, "odd", ToyTraffic())


class Astray(Noted):
    """A learner that asks for what is no phase."""

    def learn(self, env: Any, episodes: int) -> None:
        env.reset()
        env.step(dict.fromkeys(env.agents, float("nan")))


class Failing(Lazy):
    """A learner that raises an exception where it is asked to."""

    def __init__(self, place: str) -> None:
        self.place = place

    def learn(self, env: Any, episodes: int) -> None:
        env.reset()
        while env.agents:
            env.step(dict.fromkeys(env.agents, 0))
        self._fail("learn")

    def policy(self) -> Any:
        self._fail("policy")
        return super().policy()

    def save(self, path: Path) -> None:
        path.touch()
        self._fail("save")

    def load(self, path: Path) -> None: ...

    def _fail(self, place: str) -> None:
        if self.place == place:
            raise ZeroDivisionError(place)


@pytest.mark.parametrize("place", ["learn", "policy", "save"])
def test_an_exception_in_a_learner_is_told_with_its_name_and_place(place: str) -> None:
    learner = OwnLearner(Failing(place), "mine", ToyTraffic())
    says = rf"^learner 'mine': ZeroDivisionError: {place} \(.*own_test\.py, line \d+\)$"
    with pytest.raises(OptionError, match=says) as told:
        learner.learn(ToyTraffic(), 1, 0)
    assert isinstance(told.value.__cause__, ZeroDivisionError)


def test_what_a_callback_raises_is_no_error_of_the_learner() -> None:
    def stop(episode: int, numbers: Any) -> None:
        raise LookupError("enough")

    with pytest.raises(LookupError, match="enough"):
        OwnLearner(Failing("nowhere"), "mine", ToyTraffic()).learn(ToyTraffic(), 1, 0, stop)


def test_a_mistake_inside_a_learner_is_told_with_its_place() -> None:
    env = ugat_marl.parallel_env("single-v1", duration_s=20)
    with pytest.raises(ActionError, match=r"learner 'astray' \(.*own_test\.py, line \d+\): action"):
        OwnLearner(Astray(), "astray", env).learn(env, 1, 0)
    env.close()


@pytest.mark.usefixtures("algorithm")
def test_what_a_learner_has_saved_is_told_from_damage(tmp_path: Path) -> None:
    learner = OwnLearnerFactory("my_algo:Kept")(ToyTraffic(), 0)
    learner.save(tmp_path / "own.pt")
    with pytest.raises(CheckpointError, match=r"own\.pt: what a learner of .*CLASS@/.*own\.pt;"):
        ugat_marl.load_policy(tmp_path / "own.pt")
    with pytest.raises(CheckpointError, match="commands that play policies take it as it is"):
        ugat_marl.load_policy(f"my_algo:Kept@{tmp_path / 'own.pt'}")


@pytest.mark.usefixtures("algorithm")
def test_options_that_continue_a_learner_need_one_that_can_be_kept(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert trained(tmp_path / "run", "my_algo:Cycle", "--fine-tuned") == 2
    assert "fine_tuned starts from the learner of direct transfer" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ({"neighbours": 1}, "'neighbours', which the command decides; .* observation, commands"),
        ({"reward": "pressure"}, "'reward', which the command decides"),
        ({"duration_s": 100.0}, "'duration_s', which the command decides"),
        ({"observation": len}, "a function as observation, which no run can write down"),
    ],
)
def test_a_learner_asks_for_what_it_sees_and_no_more(
    algorithm: Any, monkeypatch: pytest.MonkeyPatch, asked: dict[str, Any], says: str
) -> None:
    monkeypatch.setattr(algorithm.Cycle, "env_options", asked, raising=False)
    with pytest.raises(OptionError, match=says):
        ugat_marl.train("single-v1", learner="my_algo:Cycle", duration_s=100.0)


@pytest.mark.usefixtures("algorithm")
@pytest.mark.parametrize("words", [[], ["first=4"]])
def test_a_learner_is_restored_with_the_settings_of_its_training(
    algorithm: Any, monkeypatch: pytest.MonkeyPatch, words: list[str]
) -> None:
    class Phased(algorithm.Kept):
        def __init__(self, env: Any, seed: int, phase: int, first: int = 1) -> None:
            super().__init__(env, seed, first)
            self.phase = phase

        def policy(self) -> Any:
            phase = self.phase + self.hold
            return lambda observations: dict.fromkeys(observations, phase)

    def acts(policy: Any) -> Any:
        return policy.act(dict.fromkeys("ab"), {})

    monkeypatch.setattr(algorithm, "Phased", Phased, raising=False)
    learner = OwnLearnerFactory("my_algo:Phased", ["phase=2", *words])(ToyTraffic(), 0)
    learner.save(Path("kept.pt"))
    make = OwnLearnerFactory("my_algo:Phased")
    assert acts(make.read_policy(lambda **_: ToyTraffic(), Path("kept.pt"))) == acts(
        learner.policy()
    )
    other = OwnLearnerFactory("my_algo:Phased", ["phase=1"])
    restored = other.read_policy(lambda **_: ToyTraffic(), Path("kept.pt"))
    assert acts(restored)["a"] == acts(learner.policy())["a"] - 1


class WithCounters(Noted):
    """A learner that keeps a file of its own beside the path that it is given."""

    def __init__(self, note: str = "") -> None:
        self.note = note

    def save(self, path: Path) -> None:
        super().save(path)
        path.with_name("counters.json").write_text(self.note)

    def load(self, path: Path) -> None:
        super().load(path)
        self.note = path.with_name("counters.json").read_text()


def test_files_of_any_name_beside_the_state_come_back(tmp_path: Path) -> None:
    env, file, given = ToyTraffic(), tmp_path / "learner.zip", WithCounters()
    OwnLearner(WithCounters("mine"), "kept", env).save(file)
    OwnLearner(given, "kept", env).load(file)
    assert given.note == "mine"


def test_a_state_of_version_1_is_loaded(tmp_path: Path) -> None:
    """Its files stood beside the counters."""
    file, learner = tmp_path / "learner.zip", OwnLearner(Noted(), "noted", ToyTraffic())
    counters = {"episodes": 3, "env_options": {}, "settings": []}
    with zipfile.ZipFile(file, "w") as packed:
        packed.writestr("learner.pt", "noted")
        packed.writestr("counters.json", json.dumps(counters))
    learner.load(file)
    assert learner.episodes == 3


@pytest.mark.usefixtures("algorithm")
def test_a_file_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "other.pt").write_bytes(b"nothing")
    make = policy_factory("my_algo:Kept@other.pt")
    with pytest.raises(CheckpointError, match=r"other\.pt: not the state of a learner"):
        make(ugat_marl.parallel_env("single-v1"))
    with zipfile.ZipFile(tmp_path / "other.pt", "w") as archive:
        archive.writestr("data", "{}")
    with pytest.raises(CheckpointError, match="only a file that a run of the suite wrote is read"):
        make(ugat_marl.parallel_env("single-v1"))


def test_a_class_of_policies_is_made(algorithm: Any) -> None:
    class Own(algorithm.Holding):
        def __init__(self, env: Any) -> None:
            super().__init__(len(env.possible_agents))

    policy = own_policy(Own, "own", ToyTraffic())
    policy.reset(3)
    observations, infos = ToyTraffic().reset(seed=0)
    assert set(policy.act(observations, infos)) == set(observations)


def test_a_class_with_settings_of_its_own_keeps_them() -> None:
    class Held:
        def __init__(self, threshold: int = 5) -> None:
            self.threshold = threshold

        def act(self, observations: Any) -> dict[str, float]:
            return dict.fromkeys(observations, self.threshold - 4.1)

    policy = own_policy(Held, "held", ToyTraffic())
    observations, infos = ToyTraffic().reset(seed=0)
    with pytest.raises(OptionError, match="it must be the number of a phase, one whole number"):
        policy.act(observations, infos)  # 0.9 is not a phase


@pytest.mark.usefixtures("algorithm")
def test_a_learner_in_the_place_of_a_policy_is_refused_with_the_way_out() -> None:
    with pytest.raises(OptionError, match="'my_algo:Cycle' is a learner.*my_algo:Cycle@FILE"):
        policy_factory("my_algo:Cycle")(ToyTraffic())
    with pytest.raises(OptionError, match="'mine' is a learner.*mine@FILE"):
        own_policy(Noted, "mine", ToyTraffic())  # a class that is made without arguments


def test_a_class_that_needs_more_is_refused() -> None:
    class Greedy:
        def __init__(self, env: Any, depth: int) -> None: ...

    with pytest.raises(OptionError, match=r"Greedy\(env\) .* takes \(env.*depth.*give further"):
        own_policy(Greedy, "greedy", ToyTraffic())


@pytest.mark.usefixtures("algorithm")
def test_names_that_a_module_imports_are_not_among_its_own() -> None:
    with pytest.raises(UnknownNameError) as error:
        load_own("my_algo:Nothing", "learner")
    assert "Cycle" in error.value.allowed
    assert not {"Path", "Any", "np"} & set(error.value.allowed)
    assert not any(name.islower() for name in error.value.allowed), "functions do not learn"
    with pytest.raises(UnknownNameError) as error:
        load_own("my_algo:Cycle.Nothing", "learner")
    assert {"learn", "policy"} <= set(error.value.allowed)


@pytest.mark.usefixtures("algorithm")
def test_tables_need_a_learner_that_can_be_kept(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["paper", "main", "--learner", "my_algo:Cycle"]) == 2
    assert "rows of a table start from what direct transfer has learnt" in capsys.readouterr().err


def test_an_error_in_a_policy_is_told_with_its_name_and_place(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "failing.py"
    file.write_text(
        "import json\n"
        "def act(observations, infos):\n"
        "    return observations['nobody']\n"
        "class Reader:\n"
        "    def reset(self):\n"
        "        json.loads('{')\n"
        "    def act(self, observations, infos):\n"
        "        return {}\n"
    )
    call = ["evaluate", "single-v1", "--domains", "sim", "--seeds", "1", "--duration-s", "60"]
    assert main([*call, "--policies", f"{file}:act"]) == 2
    said = f"policy '{file}:act': KeyError: 'nobody' ({file}, line 3)\n"
    assert capsys.readouterr().err.endswith(said)
    failing = OwnPolicy(load_own(f"{file}:Reader", "policy")(), "mine", {})
    place = r"failing\.py, line 6\), raised in .*decoder\.py, line \d+$"
    with pytest.raises(OptionError, match=place) as told:
        failing.reset(0)
    assert isinstance(told.value.__cause__, json.JSONDecodeError)
    learner = SimpleNamespace(policy=lambda: failing)
    with pytest.raises(OptionError, match=r"before its training \(policy 'mine': JSONDecodeError"):
        check_own_learner(lambda *_: learner, ToyTraffic(), 0)
