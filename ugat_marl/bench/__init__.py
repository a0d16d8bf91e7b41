"""The suite's figures, measured: speed of the environment, cost and worth of learning, memory.

Every bench is a frozen dataclass of options with a ``run()`` that returns a `Report`: rows, targets
and what they were measured on. Ratios are taken between runs of the same round, next to each other
in time, since a machine's speed drifts by more than what is measured.
"""

from ugat_marl.bench.device import DeviceBench
from ugat_marl.bench.everything import AllBench
from ugat_marl.bench.fitting import FittingBench
from ugat_marl.bench.learning import LearningBench
from ugat_marl.bench.memory import MemoryBench
from ugat_marl.bench.report import Report, Spread, Target
from ugat_marl.bench.scale import ScaleBench
from ugat_marl.bench.speed import EnvBench
from ugat_marl.bench.strength import StrengthBench

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
