"""Conformance kit: checks of environments, policies and scenarios against the suite's rules.

A function ``check_...`` runs all checks of a subject and returns their results; `check_report`
shows them. A tuple ``..._CHECKS`` holds the single checks. A check is a function of a case. It
raises `ConformanceError` if the subject breaks the rule.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
