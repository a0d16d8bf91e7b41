"""Data: what is recorded, read and kept in files.

`TransitionLog` holds transitions of roll-outs, `measured` the measured data of a street and its
readers, `runs` the folder of a training run. Nothing here computes statistics.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
