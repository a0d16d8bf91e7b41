"""Conformance kit: checks of environments, policies and scenarios against the suite's rules.

``check_...`` run all checks and return their results; ``..._CHECKS`` are the checks one by one. A
check is a function of a case that raises `ConformanceError`; `report` shows results.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
