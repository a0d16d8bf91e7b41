"""``bench learning``: measure the cost of learning in an episode, and of agents in an update."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from studies.bench.fresh_process import in_fresh_process
from studies.bench.report import Report, Spread, Target, require_positive
from ugat_marl.progress import Reporter, Silent

_PROGRAM = ["-m", "studies.bench.learning_program"]


@dataclass(frozen=True)
class LearningBench:
    """Measure the cost of DQN with one batched update of all agents per decision.

    A training episode is compared with the same episode without a learner. Seed and random actions
    are the same, so the traffic is the same. Both alternate in one process; the simulator of the
    environment runs in its worker process.

    Examples:
        python -m studies.bench learning --out learning.json

    Attributes:
        scenario: Scenario to simulate.
        rounds: Pairs of episodes; medians and quartiles are over these.
        duration_s: Simulated seconds per episode.
        warmup_decisions: Decisions before the first update; the measurement begins after them.
        updates: Updates per repetition in the comparison of one agent with all.
        repetitions: Repetitions of that comparison.
        seed: Seed of simulation, exploration and weights.
        out: JSON file to write.
    """

    scenario: str = "grid4x4-v1"
    rounds: int = 5
    duration_s: float = 3600.0
    warmup_decisions: int = 200
    updates: int = 200
    repetitions: int = 15
    seed: int = 1
    out: Path | None = None

    def __post_init__(self) -> None:
        require_positive(
            "learning",
            rounds=self.rounds,
            warmup_decisions=self.warmup_decisions,
            updates=self.updates,
            repetitions=self.repetitions,
        )

    def run(self, reporter: Reporter | None = None) -> Report:
        """Measure, and write `out` if it is given.

        Args:
            reporter: Reporter of the progress.

        Raises:
            MeasurementError: The measured process failed.
        """
        with (reporter or Silent()).task(f"learning on {self.scenario}", 1):
            found = in_fresh_process(_PROGRAM, {**asdict(self), "out": None})
        agents = found["agents"]
        training, plain = Spread.of(found["training_s"]), Spread.of(found["plain_s"])
        overhead = Spread.of_ratios(found["training_s"], found["plain_s"])
        one, many = Spread.of(found["update_one_s"]), Spread.of(found["update_all_s"])
        growth = Spread.of_ratios(found["update_all_s"], found["update_one_s"])
        rows = [
            _row("episode with random actions [s]", plain, None),
            _row("training episode, the same actions [s]", training, overhead),
            _row("update of 1 agent [ms]", _milliseconds(one), None),
            _row(f"update of {agents} agents [ms]", _milliseconds(many), growth),
        ]
        targets = [
            Target("training episode / episode", overhead.median, 1.6, at_least=False),
            Target(f"update of {agents} agents / 1 agent", growth.median, 3.0, at_least=False),
        ]
        added = Spread.of(
            [a - b for a, b in zip(training.values, plain.values, strict=True)]
        ).median
        notes = [
            f"{self.scenario}, {agents} agents, {found['decisions']} decisions and "
            f"{found['updates']} updates per training episode. Median (first-third quartile).",
            f"Learning adds {1e3 * added / found['decisions']:.2f} ms to a decision. "
            "Random actions jam the network, which makes SUMO slow and the ratio small.",
        ]
        report = Report("learning", asdict(self), rows, targets, notes)
        if self.out is not None:
            report.write(self.out)
        return report


def _milliseconds(seconds: Spread) -> Spread:
    return Spread.of([1e3 * value for value in seconds.values])


def _row(name: str, spread: Spread, ratio: Spread | None) -> dict[str, Any]:
    return {"what": name, "time": spread, "ratio to the row above": ratio or "-"}
