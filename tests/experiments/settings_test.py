"""Identity of a learner: what decides its policy, and nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest

from ugat_marl.errors import OptionError
from ugat_marl.experiments.settings import LearnerSpec
from ugat_marl.policies import DQNConfig, own_name


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
