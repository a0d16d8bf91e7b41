"""Effects: named physical values that turn a scenario into another scenario.

The same value makes a "real" domain different from the simulation, is what a diagnosis names, and
is what repairs a model. `domains` names lists of effects, V1 to V4 of the UGAT paper among them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
