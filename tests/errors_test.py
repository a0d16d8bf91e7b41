"""What a wrong name is answered with."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pytest

from ugat_marl.errors import (
    LISTED,
    OptionError,
    UnknownNameError,
    require_kinds,
    require_ranges,
)


def test_a_short_list_is_whole_and_names_with_commas_are_told_apart() -> None:
    said = str(UnknownNameError("row", "timd", ["UGAT, timed", "UGAT"]))
    assert said == "unknown row 'timd'. Did you mean 'UGAT, timed'? Known: UGAT, 'UGAT, timed'."


def test_of_a_long_list_the_nearest_are_shown_and_the_rest_counted() -> None:
    names = [f"effect_{number}" for number in range(LISTED)] + ["delay", "delays"]
    error = UnknownNameError("effect", "dely", names, "See the page.")
    said = str(error)
    assert said.startswith("unknown effect 'dely'. Did you mean 'delay'? Known: delay, delays, ")
    assert said.endswith("and 2 more. See the page.")
    assert error.allowed == sorted(names)


def test_the_only_name_that_begins_so_is_meant() -> None:
    names = ["observation", "reward", "neighbours"]
    assert "Did you mean 'observation'?" in str(UnknownNameError("option", "obs", names))
    assert "Did you mean" not in str(UnknownNameError("option", "ob", names))


def test_what_is_only_a_little_alike_is_not_meant() -> None:
    for name, known in (("learning", ["flag", "lr"]), ("nope", ["EnvOpt"])):
        assert "Did you mean" not in str(UnknownNameError("setting", name, known))
    assert "Did you mean 'V1'?" in str(UnknownNameError("domain", "V5", ["V1", "noise-5"]))


def test_where_nothing_is_known_nothing_is_listed() -> None:
    assert str(UnknownNameError("learner in math", "x", [])) == "unknown learner in math 'x'."


@dataclass(frozen=True)
class Inner:
    """A part of the settings."""


@dataclass(frozen=True)
class Settings:
    number: float = 1.0
    count: int | None = None
    switch: bool = False
    names: tuple[str, ...] = ()
    mode: Literal["slow", "fast"] = "slow"
    other: object = None
    inner: Inner = Inner()
    spare: Inner | None = None


@pytest.mark.parametrize(
    "given",
    [
        {"number": 1}, {"number": np.float32(2.0)}, {"count": np.int64(3)}, {"count": None},
        {"switch": np.True_}, {"names": ["a"]}, {"names": {"a"}}, {"names": frozenset()},
        {"mode": "fast"}, {"other": 3}, {"inner": Inner()}, {"spare": None},
    ],
)  # fmt: skip
def test_values_of_their_kinds_pass(given: dict[str, Any]) -> None:
    require_kinds(Settings(**given), "settings")


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"number": "1"}, "settings number is '1'; allowed: a number"),
        ({"number": True}, "number is True"),
        ({"count": 2.5}, "count is 2.5; allowed: a whole number or None"),
        ({"switch": 1}, "switch is 1; allowed: True or False"),
        ({"names": "a"}, "names is 'a'; allowed: a list, of which each is a text"),
        ({"names": [1]}, r"names is \[1\]"),
        ({"mode": "quick"}, "mode is 'quick'; allowed: slow, fast"),
        ({"inner": None}, "inner is None; allowed: an Inner"),
        ({"spare": {}}, "spare is {}; allowed: an Inner or None"),
    ],
)
def test_values_of_other_kinds_are_refused(given: dict[str, Any], told: str) -> None:
    with pytest.raises(OptionError, match=told):
        require_kinds(Settings(**given), "settings")


@dataclass(frozen=True)
class Ranged:
    """One field per range."""

    size: int = 2
    rate: float = 1.0
    weight: float = 0.0
    share: float = 1.0
    level: float = 0.0

    def __post_init__(self) -> None:
        require_ranges(
            self,
            "ranged",
            at_least={"size": 2},
            positive=("rate",),
            non_negative=("weight",),
            shares=("share",),
            below_one=("level",),
        )


def test_numbers_at_the_ends_of_their_ranges_pass() -> None:
    Ranged()
    Ranged(rate=5e-324, share=0.0, level=1.0 - 2.0**-53)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"size": 1}, "ranged size is 1; allowed: >= 2"),
        ({"rate": 0.0}, "rate is 0.0; allowed: > 0, finite"),
        ({"rate": math.inf}, "rate is inf; allowed: > 0, finite"),
        ({"weight": -5e-324}, "weight is -5e-324; allowed: >= 0, finite"),
        ({"weight": math.inf}, "weight is inf; allowed: >= 0, finite"),
        ({"share": 1.0 + 2.0**-52}, "allowed: 0 to 1"),
        ({"level": 1.0}, "level is 1.0; allowed: from 0 to below 1"),
        *(({name: math.nan}, f"{name} is nan") for name in ("rate", "weight", "share", "level")),
    ],
)
def test_numbers_out_of_their_ranges_are_refused(given: dict[str, Any], told: str) -> None:
    with pytest.raises(OptionError, match=told):
        Ranged(**given)
