"""Search for settings of a learner with Ray Tune, by the public functions of ugat_marl.

    python with_ray_tune.py --trials 10 --out runs/tune

Trials run in parallel processes, one core each.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ray import tune

import ugat_marl

CHOOSING = (5001, 5002)
"""Seeds on which trials are judged; reported results use seeds of their own."""


def trial(config: dict[str, Any]) -> dict[str, float]:
    """Train with the settings of a trial and return its travel time in s."""
    run = ugat_marl.train(
        config["scenario"],
        real=config["real"],
        learner="ippo",
        learner_settings=[
            f"learning_rate={config['learning_rate']}",
            f"entropy_weight={config['entropy_weight']}",
        ],
        pretrain_episodes=config["episodes"],
        grounded_episodes=max(1, config["episodes"] // 2),
        iterations=1,
        grounding="timed",
        control=False,
        evaluation_seeds=1,
        duration_s=config["duration_s"],
        out=Path(config["out"]) / tune.get_context().get_trial_id(),
        workers=1,
    )
    scores = ugat_marl.evaluate(
        config["scenario"],
        run.policies["ugat-timed"],
        [config["real"]],
        seeds=CHOOSING,
        duration_s=config["duration_s"],
        workers=1,
    )
    return {"att_s": float(scores["att_s"].mean())}


def main() -> None:
    """Search, and print the best settings."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scenario", default="single-v1")
    parser.add_argument("--real", default="V4")
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--episodes", type=int, default=10, help="of plain training")
    parser.add_argument("--duration-s", type=float, default=1800.0)
    parser.add_argument("--out", type=Path, default=Path("runs/tune"))
    given = parser.parse_args()
    space = {
        "learning_rate": tune.loguniform(1e-4, 1e-2),
        "entropy_weight": tune.loguniform(1e-3, 1e-1),
        "scenario": given.scenario,
        "real": given.real,
        "episodes": given.episodes,
        "duration_s": given.duration_s,
        "out": str(given.out.resolve()),
    }
    tuner = tune.Tuner(
        trial,
        param_space=space,
        tune_config=tune.TuneConfig(metric="att_s", mode="min", num_samples=given.trials),
        run_config=tune.RunConfig(storage_path=str(given.out.resolve()), verbose=0),
    )
    best = tuner.fit().get_best_result()
    chosen = {name: best.config[name] for name in ("learning_rate", "entropy_weight")}
    print(f"best travel time {best.metrics['att_s']:.1f} s with {chosen}")


if __name__ == "__main__":
    main()
