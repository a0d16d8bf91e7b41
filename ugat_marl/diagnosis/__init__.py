"""Diagnosis: where simulation and measured data disagree, and which effect is missing.

The stages are locate, propose, fit, select and verify; `workflow` runs them from data to a
corrected scenario.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
