"""Experiments: settings x domains x seeds, trained, evaluated and compared with intervals.

`transfers` trains across the gap and judges in both worlds, `evaluation` plays policies, `paper`
holds the tables of the UGAT paper as lists of settings.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
