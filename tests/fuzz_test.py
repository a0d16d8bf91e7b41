"""A few damaged inputs of every surface; `tests/nightly/fuzz_test.py` tries thousands."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fuzz_surfaces import use_commands
from tests.fuzzing import KEPT, Surface, attempt, attempt_kept, built, surfaces
from ugat_marl.errors import OptionError

INPUTS = 8
"""Damaged inputs of each surface; a seed draws each of them."""


@pytest.fixture(scope="module", params=sorted(surfaces()))
def sound(request: pytest.FixtureRequest) -> Iterator[tuple[Surface, Path]]:
    surface = surfaces()[request.param]
    with built(surface) as folder:
        yield surface, folder


def test_damaged_inputs_are_read_or_refused_in_one_line(sound: tuple[Surface, Path]) -> None:
    surface, folder = sound
    few = max(1, round(INPUTS * surface.share))
    faults = {seed: attempt(surface, seed, folder) for seed in range(few)}
    assert {seed: fault for seed, fault in faults.items() if fault} == {}


def test_what_failed_once_is_mended(sound: tuple[Surface, Path]) -> None:
    surface, folder = sound
    faults = {case: attempt_kept(surface, case, folder) for case in KEPT.glob(f"{surface.name}/*")}
    assert {case: fault for case, fault in faults.items() if fault} == {}


def subject(tmp_path: Path, use: object) -> tuple[Surface, Path]:
    (tmp_path / "a.txt").write_text('a = 3\nb = "four"\n')
    return Surface("toy", lambda _: None, use), tmp_path


def test_the_harness_sees_a_traceback_lines_and_a_hang(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def crash(_: Path) -> None:
        raise ValueError("odd")

    def lines(_: Path) -> None:
        raise OptionError("one\ntwo")

    def refuse(_: Path) -> None:
        raise OptionError("one")

    def hang(_: Path) -> None:
        while True:
            pass

    monkeypatch.setattr("tests.fuzzing.MOST_S", 0.2)
    assert attempt(*_with_seed(subject(tmp_path, crash))).startswith("traceback: ValueError: odd")
    assert attempt(*_with_seed(subject(tmp_path, lines))).startswith("several lines")
    assert attempt(*_with_seed(subject(tmp_path, hang))).startswith("hang")
    assert attempt(*_with_seed(subject(tmp_path, refuse))) == ""


def _with_seed(given: tuple[Surface, Path]) -> tuple[Surface, int, Path]:
    return given[0], 1, given[1]


@pytest.mark.parametrize(
    ("code", "said", "fault"),
    [(0, "", ""), (2, "one\n", ""), (1, "", "ended with 1"), (2, "one\ntwo\n", "ended with 2")],
)
def test_a_command_that_ends_with_another_code_is_seen(
    code: int, said: str, fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def end(_: list[str]) -> int:
        sys.stderr.write(said)
        return code

    monkeypatch.setattr("tests.fuzz_surfaces.main", end)
    (tmp_path / "commands.txt").write_text("domains\n")
    seen = attempt(Surface("toy", lambda _: None, use_commands, (lambda *_: None,)), 1, tmp_path)
    assert fault in seen and bool(seen) == bool(fault)


def test_the_same_seed_is_the_same_damage(tmp_path: Path) -> None:
    seen: list[bytes] = []
    surface, folder = subject(tmp_path, lambda f: seen.append((f / "a.txt").read_bytes()))
    for seed in (1, 2, 1):
        attempt(surface, seed, folder)
    assert seen[0] == seen[2] != seen[1]
