"""The suite's figures, measured: speed of the environment, cost and worth of learning, memory.

Every bench is a frozen dataclass of options with a ``run()`` that returns a `Report`: rows, targets
and what they were measured on. Ratios are taken between runs of the same round, next to each other
in time, since a machine's speed drifts by more than what is measured.
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
