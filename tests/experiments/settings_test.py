"""Identity of a learner: what decides its policy, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, wraps
from pathlib import Path

import pytest

from ugat_marl.errors import OptionError
from ugat_marl.experiments.settings import LearnerSpec
from ugat_marl.policies import DQNConfig, is_own, own_name
from ugat_marl.policies.own_names import load_own


def test_weights_to_begin_with_count_by_their_content(tmp_path: Path) -> None:
    def identity(name: str, content: bytes) -> object:
        path = tmp_path / name
        path.write_bytes(content)
        start = DQNConfig(network="universal", hidden=(48, 48), start=str(path))
        return LearnerSpec("universal", (), start).identity

    assert identity("a.pt", b"one") == identity("moved.pt", b"one")
    assert identity("a.pt", b"one") != identity("a.pt", b"other")


def test_the_file_of_a_user_s_learner_counts_by_its_content(tmp_path: Path) -> None:
    def identity(folder: str, value: int) -> object:
        (tmp_path / folder).mkdir()
        path = tmp_path / folder / "mine.py"
        path.write_text(f"class Mine:\n    rate = {value}\n")
        return LearnerSpec(f"{path}:Mine", (), DQNConfig()).identity["source"]

    first, same, other = identity("a", 1), identity("b", 1), identity("c", 2)
    assert first == same != other
    assert first is not None
    made = type("Typed", (), {"__module__": "builtins"})  # as at a prompt, in no file
    assert LearnerSpec(own_name(made), (), DQNConfig()).identity["source"] is None


def test_missing_weights_are_one_line() -> None:
    spec = LearnerSpec("universal", (), DQNConfig(network="universal", start="no.pt"))
    with pytest.raises(OptionError, match=r"no\.pt: No such file"):
        _ = spec.identity


class Held:
    """A learner's class; only its name and values count here."""

    def __init__(self, env: object = None, seed: int = 0, phase: int = 0) -> None:
        self.phase = phase


class Other(Held):
    """Another class of the same file."""


def plain(env: object, seed: int) -> Held:
    """A learner's maker."""
    return Held(env, seed)


def renamed(make: Callable[[object, int], Held]) -> Callable[[object, int], Held]:
    @wraps(make)
    def inner(env: object, seed: int) -> Held:
        return make(env, seed + 1)

    return inner


decorated = renamed(plain)


def within(phase: int) -> Callable[[object, int], Held]:
    def make(env: object, seed: int) -> Held:
        return Held(env, seed, phase)

    return make


def test_learners_with_other_values_are_other_learners() -> None:
    def identity(given: object) -> object:
        return LearnerSpec(own_name(given), (), DQNConfig()).identity

    for one, other in (
        (partial(Held, phase=0), partial(Held, phase=1)),
        (partial(Held, phase=0), partial(Other, phase=0)),
        (within(0), within(1)),
    ):
        assert identity(one) != identity(other)
    assert identity(within(1)) == identity(within(1))
    assert identity(partial(Held, phase=1)) == identity(partial(Held, phase=1))
    assert own_name(decorated) != own_name(plain)
    assert load_own(own_name(decorated), "learner") is decorated
    named = own_name(partial(Held, phase=0))
    assert is_own(named) and named != own_name(Held)
    held = LearnerSpec(named, (), DQNConfig()).identity
    assert held["source"] == LearnerSpec(own_name(Held), (), DQNConfig()).identity["source"]
