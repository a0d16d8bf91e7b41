"""Search for settings of a learner with Ray Tune, by the public functions of ugat_marl.

    python with_ray_tune.py --trials 10 --out runs/ray-tune

Every trial runs in a process of Ray's own, so as many run at once as the machine has cores. A trial
that is behind is ended by ASHA.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from ray import tune
from ray.tune.schedulers import ASHAScheduler

import ugat_marl

CHOOSING = (5001, 5002)
"""Seeds on which trials are judged; reported results use seeds of their own."""


def trial(settings: Mapping[str, float], given: argparse.Namespace) -> None:
    """Train with these settings, and report returns on the way and the travel time at the end."""

    def report(stage: str, step: int, numbers: Mapping[str, float]) -> None:
        if stage == "episode" and step < given.episodes:
            tune.report({"score": numbers["return"]})

    # Ray starts a trial in a folder of its own, so places are absolute.
    folder = Path(tempfile.mkdtemp(prefix="trial-", dir=given.out))
    run = ugat_marl.train(
        given.scenario,
        real=given.real,
        learner="ippo",
        learner_settings=[f"{name}={value}" for name, value in settings.items()],
        pretrain_episodes=given.episodes,
        grounded_episodes=max(1, given.episodes // 2),
        iterations=1,
        grounding="timed",
        control=False,
        evaluation_seeds=1,
        duration_s=given.duration_s,
        out=folder / "run",
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
    att_s = float(scores["att_s"].mean())
    tune.report({"score": -att_s, "att_s": att_s})


def main() -> None:
    """Search, and print the best settings."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scenario", default="single-v1")
    parser.add_argument("--real", default="V4")
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--episodes", type=int, default=10, help="of plain training")
    parser.add_argument("--duration-s", type=float, default=1800.0)
    parser.add_argument("--out", type=Path, default=Path("runs/ray-tune"))
    given = parser.parse_args()
    given.out = given.out.resolve()
    given.out.mkdir(parents=True, exist_ok=True)
    space: dict[str, Any] = {
        "learning_rate": tune.loguniform(1e-4, 1e-2),
        "entropy_weight": tune.loguniform(1e-3, 1e-1),
    }
    tuner = tune.Tuner(
        tune.with_resources(partial(trial, given=given), {"cpu": 1}),
        param_space=space,
        tune_config=tune.TuneConfig(
            metric="score",
            mode="max",
            num_samples=given.trials,
            scheduler=ASHAScheduler(max_t=given.episodes + 1, grace_period=min(3, given.episodes)),
        ),
        run_config=tune.RunConfig(name="search", storage_path=str(given.out), verbose=1),
    )
    results = tuner.fit()
    if results.errors:
        raise results.errors[0]
    finished = [result for result in results if result.metrics and "att_s" in result.metrics]
    best = min(finished, key=lambda result: result.metrics["att_s"])
    print(f"best travel time {best.metrics['att_s']:.1f} s with {best.config}")


if __name__ == "__main__":
    main()
