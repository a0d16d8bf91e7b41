"""``bench scale``: its arithmetic by hand, and its programs at their smallest."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
import pytest

from studies.bench.fresh_process import in_fresh_process
from studies.bench.report import Report, Spread
from studies.bench.scale import PARTS, Figure, ScaleBench, _told
from studies.bench.scale_program import WORK, _memory_mib, _vehicles, cycle
from ugat_marl.envs import parallel_env
from ugat_marl.errors import OptionError

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a system that can fork")


def test_a_figure_is_a_row_and_a_target() -> None:
    figure = Figure("ratio", Spread.of([1.0, 2.0, 3.0]), 1.7, 1.9, True)
    assert figure.row()["reach"] == ">= 1.7"
    assert figure.target.measured == 2.0
    assert figure.target.met
    assert not Figure("growth", 1.6, 1.5, 1.0, False).target.met
    told = _told("memory", 3.0).row()
    assert (told["reach"], told["aim"]) == ("", "")
    assert math.isnan(_told("memory", 3.0).reach)


def test_greens_take_turns_and_only_allowed_ones() -> None:
    free = np.ones((1, 1, 4), dtype=np.int8)
    shown = [int(cycle(free, decision)[0, 0]) for decision in range(15)]
    assert shown == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 0, 0, 0]
    held = np.array([[[0, 0, 1, 0], [1, 1, 1, 0]]], dtype=np.int8)  # the second lacks the fourth
    assert [cycle(held, decision)[0].tolist() for decision in (0, 3, 9)] == [[2, 0], [2, 1], [2, 0]]


def test_vehicles_are_counted_back_from_observations() -> None:
    env = parallel_env("single-v1", duration_s=300)
    observations, infos = env.reset(seed=1)
    while env.agents:
        masks = {agent: infos[agent]["action_mask"] for agent in env.agents}
        observations, _, _, _, infos = env.step({a: int(cycle(m, 0)) for a, m in masks.items()})
    counts = np.array([[observations[agent] for agent in env.possible_agents]])
    lanes = env.network.lane_table()
    incoming = lanes.indices(env.network.intersections[0].incoming_lanes)
    there = float(env.snapshot.vehicles[incoming].sum())
    env.close()
    assert there > 0
    assert _vehicles(counts) == pytest.approx(there, abs=1e-3)


def test_memory_that_is_written_to_counts() -> None:
    before = _memory_mib()
    held = np.ones(8 << 20)
    assert _memory_mib() - before == pytest.approx(held.nbytes / 2**20, abs=16)


def ask(work: str, **request: Any) -> Any:
    return in_fresh_process(["-m", "studies.bench.scale_program"], {"work": work, **request})


@pytest.mark.slow
def test_killed_and_unharmed_episodes_have_one_digest() -> None:
    asked = {"scenario": "single-v1", "n": 2, "episodes": 6, "duration_s": 100.0, "seed": 1}
    harmed, unharmed = ask("kills", kills=5, **asked), ask("kills", kills=0, **asked)
    assert harmed["digest"] == unharmed["digest"]
    assert (harmed["killed"], unharmed["killed"]) == (5, 0)
    assert harmed["episodes"] == unharmed["episodes"] == 6


def test_what_is_sumo_s_and_what_is_not_is_all() -> None:
    asked = {"scenario": "grid2x2-v1", "duration_s": 500.0, "seed": 1, "settled": 20}
    found = WORK["split"]({**asked, "decisions": 20})
    assert found["sumo_ms"] > found["rest_ms"] > 0
    assert found["us_per_vehicle_s"] > 0.1


@pytest.mark.slow
def test_a_report_of_the_leaks() -> None:
    report = ScaleBench(parts=("leaks",), environments=2, resets=16).run()
    assert isinstance(report, Report)
    rows = {row["figure"]: row["measured"] for row in report.rows}
    assert rows["more processes after 16 resets"] == 0
    assert rows["more open files after 16 resets"] == 0


def test_wrong_options() -> None:
    assert set(WORK) == {
        "steps", "split", "grounded", "leaks", "kills", "decide", "learner", "ray",
    }  # fmt: skip
    with pytest.raises(OptionError, match="parts holds 'speed'; allowed: workers, grounded"):
        ScaleBench(parts=("speed",))
    with pytest.raises(OptionError, match="rounds = 0"):
        ScaleBench(rounds=0)
    assert "ray" in PARTS


@pytest.mark.slow
def test_a_training_s_time_is_divided_between_sumo_torch_and_the_rest() -> None:
    asked = {"scenario": "single-v1", "duration_s": 600.0, "learner": "ippo", "seed": 1}
    shares = ask("learner", episodes=2, **asked)
    assert set(shares) == {"libsumo", "torch", "rest"}
    assert min(shares.values()) > 0


def test_a_library_that_is_not_installed_is_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("studies.bench.scale._is_installed", lambda name: False)
    report = ScaleBench(parts=("learner",)).run()
    assert report.rows == [] and "library of sb3-ppo is not installed" in report.notes[-1]
