"""Benchmarks: speed, many simulations, learning, fits, GPUs, memory, the field loop under faults.

Every bench is a frozen dataclass of options with a ``run()`` that returns a `Report`: rows, targets
and the machine. Ratios are taken between runs of the same round, which follow each other directly,
because the speed of a machine drifts by more than the measured differences.
"""

from studies.bench.device import DeviceBench
from studies.bench.env import EnvBench
from studies.bench.everything import AllBench
from studies.bench.fitting import FittingBench
from studies.bench.learning import LearningBench
from studies.bench.memory import MemoryBench
from studies.bench.report import Report, Spread, Target
from studies.bench.scale import ScaleBench
from studies.bench.strength import StrengthBench

__all__ = [
    "AllBench",
    "DeviceBench",
    "EnvBench",
    "FittingBench",
    "LearningBench",
    "MemoryBench",
    "Report",
    "ScaleBench",
    "Spread",
    "StrengthBench",
    "Target",
]
