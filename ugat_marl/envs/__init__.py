"""Environments: PettingZoo's `ParallelEnv` with one agent per signalised intersection.

`TrafficEnv` composes observations, rewards, and the sensors, actuators and objectives that the
effects of its scenario make. `wrappers` change what a learner sees, `vector` steps many
environments at once in processes of a `simulation.Host`, `adapters` fit other libraries.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
