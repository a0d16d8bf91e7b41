"""Environments: PettingZoo's `ParallelEnv` with one agent per signalised intersection.

- `traffic_env`, `options`: `TrafficEnv` simulates a scenario; `EnvOptions` are its options.
- `observations`, `rewards`, `actions`: observation vectors, rewards, and checks of actions.
- `sensors`, `actuators`, `objectives`: effects on the counts and commands of controllers, and on
  the cost of an episode.
- `wrappers`: other observations and equal spaces for learners; `agents` makes padded arrays.
- `vector`: many environments in worker processes, stepped together.
- `adapters`: environments in the form of other libraries.
- `commands`: memory of an agent's own commands; `signal_programmes`: phases of lights that run
  SUMO's own programmes.
- `single`, `registration`: one light as an environment of Gymnasium, and the names there.
- `description`: tables of what agents see and choose; `rendering`: pictures of the network.
- `types`: types of arguments and results, by agent; `unwrapping`: what is inside wrappers.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
