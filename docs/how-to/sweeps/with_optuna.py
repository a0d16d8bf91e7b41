"""Search for settings of a learner with Optuna, by the public functions of ugat_marl.

    python with_optuna.py --trials 10 --out runs/optuna

A trial that is behind is pruned: its training is ended by an exception of the callback.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping
from pathlib import Path

import optuna

import ugat_marl

CHOOSING = (5001, 5002)
"""Seeds on which trials are judged; reported results use seeds of their own."""


def main() -> None:
    """Search, and print the best settings."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scenario", default="single-v1")
    parser.add_argument("--real", default="V4")
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--episodes", type=int, default=10, help="of plain training")
    parser.add_argument("--duration-s", type=float, default=1800.0)
    parser.add_argument("--out", type=Path, default=Path("runs/optuna"))
    given = parser.parse_args()

    def objective(trial: optuna.Trial) -> float:
        settings = [
            f"learning_rate={trial.suggest_float('learning_rate', 1e-4, 1e-2, log=True)}",
            f"entropy_weight={trial.suggest_float('entropy_weight', 1e-3, 1e-1, log=True)}",
        ]

        def report(stage: str, step: int, numbers: Mapping[str, float]) -> None:
            if stage == "episode" and step < given.episodes:
                trial.report(numbers["return"], step)
                if trial.should_prune():
                    raise optuna.TrialPruned

        run = ugat_marl.train(
            given.scenario,
            real=given.real,
            learner="ippo",
            learner_settings=settings,
            pretrain_episodes=given.episodes,
            grounded_episodes=max(1, given.episodes // 2),
            iterations=1,
            grounding="timed",
            control=False,
            evaluation_seeds=1,
            duration_s=given.duration_s,
            out=Path(tempfile.mkdtemp(prefix="trial-", dir=given.out)) / "run",
            workers=1,
            callback=report,
        )
        policy = run.policies["timed"]
        scores = ugat_marl.evaluate(
            given.scenario,
            policy,
            [given.real],
            seeds=CHOOSING,
            duration_s=given.duration_s,
            workers=1,
        )
        # returns, which are reported on the way, and the result are both larger for better trials
        return -float(scores["att_s"].mean())

    given.out.mkdir(parents=True, exist_ok=True)
    study = optuna.create_study(
        direction="maximize",
        pruner=optuna.pruners.MedianPruner(n_startup_trials=3, n_warmup_steps=3),
        sampler=optuna.samplers.TPESampler(seed=1),
    )
    study.optimize(objective, n_trials=given.trials)
    print(f"best travel time {-study.best_value:.1f} s with {study.best_params}")


if __name__ == "__main__":
    main()
