"""``ugat-marl export``: write a trained policy to a file that runs without this package."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import Positional, arg

from ugat_marl.effects import load_scenario
from ugat_marl.envs import parallel_env
from ugat_marl.policies import export_policy, load_policy


@dataclass(frozen=True)
class Export:
    """Write a trained policy as TorchScript, ONNX or matrices.

    The files are described in docs/how-to/export.md.

    Examples:
        ugat-marl export runs/demo/policies/direct-transfer.pt
        --out policy.onnx --scenario single-v1
        ugat-marl export runs/demo/policies/direct-transfer.pt --out policy.npz

    Attributes:
        policy: File of a trained policy.
        out: File of the model; its suffix chooses the format: .ts, .onnx or .npz. A .json is
            written beside it.
        scenario: Scenario of the training; adds decision interval and traffic lights to the .json.
    """

    policy: Annotated[Positional[Path], arg(metavar="POLICY")]
    out: Path
    scenario: str | None = None

    def run(self, console: Console) -> int:
        """Export and print the paths."""
        policy, env = load_policy(self.policy), None
        if self.scenario is not None:
            env = parallel_env(load_scenario(self.scenario), **policy.env_options)
        side_car = export_policy(policy, self.out, env)
        console.print(f"model: {self.out}", soft_wrap=True)
        console.print(f"its inputs and outputs: {side_car}", soft_wrap=True)
        return 0
