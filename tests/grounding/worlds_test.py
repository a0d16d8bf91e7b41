"""Worlds whose data say nothing: what is shuffled, and what stays where it is."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import polars as pl
import pytest

from ugat_marl.data import AgentLayout, Provenance, TransitionLog, TransitionRecorder
from ugat_marl.errors import LogError
from ugat_marl.grounding import ShuffledWorld
from ugat_marl.grounding.controls import shuffled
from ugat_marl.grounding.worlds import RecordedCommands
from ugat_marl.policies import Policy

LAYOUTS = {"a_0": AgentLayout(2, 2), "b_0": AgentLayout(1, 2, 1)}
ROWS = 60


def numbered() -> TransitionLog:
    """Every outcome carries the number of the row it belongs to, and its agent's."""
    recorder = TransitionRecorder(Provenance("numbered", "", "V4", (), 10.0, "count", LAYOUTS))
    for row in range(ROWS):
        one = np.eye(2, dtype=np.float32)[row % 2]
        seen = {"a_0": np.array([row, 0, *one]), "b_0": np.array([row, *one, 9])}
        then = {"a_0": np.array([row, 1, *one]), "b_0": np.array([row + 100, *one, 9])}
        served = {"a_0": np.array([row, 2.0]), "b_0": np.array([row + 100.0])}
        did = dict.fromkeys(LAYOUTS, row % 2)
        got = dict.fromkeys(LAYOUTS, float(row))
        held = dict.fromkeys(LAYOUTS, 0.0)
        place = row // 20, row % 20
        recorder.record(*place, seen, did, did, got, then, held, served)
    return recorder.log()


LOG = numbered()


def test_outcomes_are_dealt_out_anew_among_the_rows_of_an_agent() -> None:
    found = shuffled(LOG, seed=3)
    for agent, offset in (("a_0", 0), ("b_0", 100)):
        rows, before = found.transitions(agent), LOG.transitions(agent)
        numbers = rows.next_observation[:, 0] - offset
        assert sorted(numbers) == list(range(ROWS))  # each once, and none of another agent's
        assert (numbers == np.arange(ROWS)).sum() < 6  # one row is expected to find its own
        # What was served stays with what was seen afterwards.
        assert (rows.served_features[:, 0] - offset == numbers).all()
        # And all else stays in its place.
        for name in ("observation", "action", "executed", "reward", "episode", "step"):
            assert np.array_equal(getattr(rows, name), getattr(before, name)), name
    assert found.provenance == LOG.provenance
    one, two = (found.transitions(a).next_observation[:, 0] % 100 for a in LAYOUTS)
    assert not np.array_equal(one, two)


def test_the_order_follows_the_seed() -> None:
    assert shuffled(LOG, 3).frame.equals(shuffled(LOG, 3).frame)
    assert not shuffled(LOG, 3).frame.equals(shuffled(LOG, 4).frame)


class Counting:
    """A world with one log, that counts how it is treated."""

    def __init__(self) -> None:
        self.done: list[str] = []

    def collect(self, policy: Policy, iteration: int, seed: int) -> TransitionLog | None:
        self.done.append(f"collect {policy} {iteration} {seed}")
        return LOG if iteration < 2 else None

    def replay(self) -> Policy | None:
        self.done.append("replay")
        return None

    def stop(self) -> None:
        self.done.append("stop")


def test_a_shuffled_world_asks_the_other_one() -> None:
    world = Counting()
    nobody: Any = "nobody"
    made = ShuffledWorld(world)
    first, second = (made.collect(nobody, i, 5) for i in (0, 1))
    assert first is not None and second is not None
    assert not first.frame.equals(LOG.frame) and not first.frame.equals(second.frame)
    assert first.frame.select(pl.col("reward").sum()).item() == 2 * sum(range(ROWS))
    assert made.collect(nobody, 2, 5) is None
    assert made.replay() is None
    made.stop()
    assert world.done == [*(f"collect nobody {i} 5" for i in range(3)), "replay", "stop"]


def commanded(commands: dict[str, dict[int, list[int]]]) -> TransitionLog:
    """Commands of each agent and episode; -1 for a decision that the log lacks."""
    whole = {a: max(map(len, e.values()), default=0) for a, e in commands.items()}
    recorder = TransitionRecorder(Provenance("by hand", "", "street", (), 10.0, "count", LAYOUTS))
    seen = {"a_0": np.array([0, 0, 1, 0]), "b_0": np.array([0, 1, 0, 0])}
    zero = dict.fromkeys(LAYOUTS, 0)
    episodes = sorted({episode for e in commands.values() for episode in e})
    for episode in episodes:
        for step in range(max(whole.values())):
            asked = {a: max(0, [*e.get(episode, []), *[0] * 9][step]) for a, e in commands.items()}
            recorder.record(episode, step, seen, asked, zero, dict.fromkeys(LAYOUTS, 0.0), seen)
    log = recorder.log()
    kept = pl.Series([
        step < len(given := commands[agent].get(episode, [])) and given[step] >= 0
        for episode, step, agent in log.frame.select("episode", "step", "agent").iter_rows()
    ])  # fmt: skip
    return TransitionLog(log.provenance, log.frame.filter(kept))


def played(log: TransitionLog, episode: int, decisions: int) -> dict[str, list[int]]:
    replay = RecordedCommands(log)
    replay.reset(episode)
    acts = [replay.act(dict.fromkeys(LAYOUTS), {}) for _ in range(decisions)]
    return {agent: [act[agent] for act in acts] for agent in LAYOUTS}


def test_a_missing_decision_shifts_no_later_command() -> None:
    log = commanded({"a_0": {0: [1, -1, 0, 1]}, "b_0": {0: [-1, 1, -1, -1]}})
    assert played(log, 0, 6) == {"a_0": [1, 1, 0, 1, 1, 1], "b_0": [1, 1, 1, 1, 1, 1]}


def test_what_was_before_a_log_is_filled_with_its_own_commands() -> None:
    log = commanded({"a_0": {0: [-1, -1, -1, 1, 0]}, "b_0": {0: [-1, -1, -1, 1, 1]}})
    assert played(log, 0, 3)["a_0"] == [1, 1, 1]  # steps that count from anywhere
    since = TransitionLog(replace(log.provenance, from_begin=True), log.frame)
    assert played(since, 0, 6) == {"a_0": [1, 0, 1, 1, 0, 0], "b_0": [1] * 6}
    replay = RecordedCommands(since)
    assert (replay.lead(0), replay.decisions(0), replay.longest_lead_s) == (3, 5, 30.0)
    assert since.since(3).frame["step"].unique().sort().to_list() == [0, 1]


def test_of_a_log_that_does_not_fit_into_an_episode_the_end_is_left_out() -> None:
    log = commanded({"a_0": {0: [-1, -1, -1, 1, 0]}, "b_0": {0: [-1, -1, -1, 1, 1]}})
    since = TransitionLog(replace(log.provenance, from_begin=True), log.frame)
    replay = RecordedCommands(since, longest=4)
    assert (replay.lead(0), replay.decisions(0)) == (3, 4)  # at its own time of day
    with pytest.raises(LogError, match=r"begins 30 s after .* end after 30 s: .*--duration-s"):
        RecordedCommands(since, longest=3)


def test_episodes_without_commands_of_an_agent_are_not_repeated() -> None:
    log = commanded({"a_0": {0: [0, 0], 4: [1, 0]}, "b_0": {4: [1, 1]}})
    for episode in (0, 1):
        assert played(log, episode, 2) == {"a_0": [1, 0], "b_0": [1, 1]}
    with pytest.raises(LogError, match="no row of b_0"):
        RecordedCommands(commanded({"a_0": {0: [0]}, "b_0": {}}))
    with pytest.raises(LogError, match="no episode has a decision of every agent$"):
        RecordedCommands(commanded({"a_0": {0: [0]}, "b_0": {1: [0]}}))
