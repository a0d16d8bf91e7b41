"""Grounding: actions of the simulation that do what the policy's action does in reality.

Forward model f, inverse model h, uncertainty and gate make up a transform. `ugat` is Algorithm 1 of
the UGAT paper.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
