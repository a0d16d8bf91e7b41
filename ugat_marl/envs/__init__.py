"""Environments: PettingZoo's `ParallelEnv` with one agent per signalised intersection.

`TrafficEnv` simulates a scenario. `observations` and `rewards` define what agents see and are paid.
Effects on controllers change both, and what becomes of an action: through `sensors`, `objectives`
and `actuators`. `wrappers` change what a learner sees, `vector` steps many environments at once in
worker processes, `adapters` fit other libraries.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
