"""The field loop: a policy at a real street, behind what keeps it safe."""

from ugat_marl.field.loop import Decision, DecisionLog, FieldLoop, Summary
from ugat_marl.field.site import Site
from ugat_marl.field.street import LaneCount, Street, TraciStreet
from ugat_marl.field.watchdog import Limits

__all__ = [
    "Decision",
    "DecisionLog",
    "FieldLoop",
    "LaneCount",
    "Limits",
    "Site",
    "Street",
    "Summary",
    "TraciStreet",
]
