"""Errors of studies, in addition to those of the package."""

from __future__ import annotations

from ugat_marl.errors import UgatMarlError


class MeasurementError(UgatMarlError):
    """A measured process of a benchmark failed, or did different work from its counterpart."""


class BlindTestError(UgatMarlError):
    """A blind test's plan, labels or grades are missing or damaged, or cannot be drawn."""
