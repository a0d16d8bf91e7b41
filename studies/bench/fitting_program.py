"""Measured program: every uncertainty fitted to the same transitions, round by round."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from ugat_marl.data import TransitionLog
from ugat_marl.envs import parallel_env
from ugat_marl.grounding import (
    UNCERTAINTY_METHODS,
    FitConfig,
    Fitter,
    InverseConfig,
    InverseModel,
    Stack,
    fit_inverse,
    inverse_accuracy,
    stack_log,
)
from ugat_marl.policies import EpsilonGreedy, make_rule, observer_of, roll_out
from ugat_marl.seeding import torch_generator

RULE = "largest-queue:20"
EPSILON = 0.3
ANSWERS = 200
"""Answers of a model that are timed together."""


def recorded(request: Mapping[str, Any], domain: str) -> TransitionLog:
    """Return roll-outs of the rule with random phases in between."""
    options: dict[str, Any] = {"duration_s": request["duration_s"]}
    rule = make_rule(RULE, parallel_env(request["scenario"], domain, **options))
    env = parallel_env(request["scenario"], domain, **options, **rule.env_options)
    logs: list[TransitionLog] = []
    for number in range(request["episodes"]):
        seed = request["seed"] + number
        log = roll_out(
            env, EpsilonGreedy(rule, EPSILON), seed, record=observer_of(env, "count")
        ).log
        assert log is not None, "recording was asked for"
        logs.append(log)
    env.close()
    return TransitionLog.concatenate(logs)


def measured(
    config: FitConfig, simulated: TransitionLog, real: TransitionLog, seed: int
) -> dict[str, float]:
    """Fit once and score the fit; seconds are CPU time."""
    stack = Stack(simulated.provenance.layouts)
    model = InverseModel(stack, InverseConfig(), torch_generator(seed))
    began = time.process_time()
    report = fit_inverse(model, simulated, Fitter(config, seed))
    fitted = time.process_time() - began
    there = stack_log(real, stack)
    accuracy, mean_u = inverse_accuracy(model, there, there.next_observation, there.weight)
    calibration = report.calibration
    return {
        "fit_s": fitted,
        "epochs": report.training.epochs,
        "answer_ms": answer_ms(model),
        "accuracy": float(report.accuracy.mean()),
        "auroc": calibration.auroc,
        "risk": calibration.risk_by_coverage[2],
        "ece": calibration.ece,
        "mean_u": calibration.mean_u,
        "mean_u_off_data": calibration.mean_u_off_data,
        "auroc_off_data": calibration.auroc_off_data,
        "accuracy_there": float(accuracy.mean()),
        "mean_u_there": float(mean_u.mean()),
    }


@torch.no_grad()
def answer_ms(model: InverseModel) -> float:
    """Return CPU milliseconds of one answer for all agents."""
    row = torch.ones(len(model.stack.agents), 1, model.stack.width)
    began = time.process_time()
    for _ in range(ANSWERS):
        model.predict(row, row)
    return 1e3 * (time.process_time() - began) / ANSWERS


def measure(request: Mapping[str, Any]) -> dict[str, Any]:
    """Measure all methods in turn, each round with another seed."""
    torch.set_num_threads(1)
    simulated, real = recorded(request, "sim"), recorded(request, request["domain"])
    options = {name: request[name] for name in ("epochs", "off_data_weight")}
    configs = {method: FitConfig(uncertainty=method, **options) for method in UNCERTAINTY_METHODS}
    for config in configs.values():  # loading on first use must not count
        measured(replace(config, epochs=1), simulated, real, request["seed"])
    found: dict[str, list[dict[str, float]]] = {method: [] for method in UNCERTAINTY_METHODS}
    for number in range(request["rounds"]):
        for method, config in configs.items():
            found[method].append(measured(config, simulated, real, request["seed"] + number))
    return {
        "agents": len(simulated.agents),
        "rows": len(simulated.transitions(simulated.agents[0])),
        "methods": {
            method: {name: [one[name] for one in rounds] for name in rounds[0]}
            for method, rounds in found.items()
        },
    }


if __name__ == "__main__":
    asked, result = map(Path, sys.argv[1:3])
    result.write_text(json.dumps(measure(json.loads(asked.read_text()))))
