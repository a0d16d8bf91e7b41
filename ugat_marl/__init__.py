"""Multi-agent traffic-signal environments across the gap between simulation and street.

`parallel_env`, `env` and `vector_env` make environments, `load_scenario` reads a scenario in a
domain, and a `TransitionLog` is what roll-outs record. Each name is loaded when it is first used,
so that importing the package is cheap.
"""

import sys

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

if "gymnasium" in sys.modules:  # gymnasium.make("ugat_marl:...") imports this module
    from ugat_marl.envs import register_single

    register_single()
