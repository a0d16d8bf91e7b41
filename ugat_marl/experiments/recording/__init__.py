"""Measured data of any domain under any controller: a simulation measured as a street is."""

from ugat_marl.experiments.recording.days import record

__all__ = ["record"]
