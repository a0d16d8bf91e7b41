"""Simulation: SUMO in this process or in a process of its own, and what is measured in it.

The only room that imports libsumo. A simulator advances by some seconds with one signal state per
second and returns a `Snapshot`; at the end of an episode it returns `Trips`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
