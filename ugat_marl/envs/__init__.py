"""Environments: PettingZoo's `ParallelEnv` with one agent per signalised intersection.

`TrafficEnv` composes observations, rewards, sensors, actuators and objectives. `wrappers` change
what a learner sees, `vector` steps many environments at once, `adapters` fit other libraries.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
