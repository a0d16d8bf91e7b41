"""Recording of measured data: a simulation of any domain, measured like a real street."""

from ugat_marl.experiments.recording.days import record

__all__ = ["record"]
