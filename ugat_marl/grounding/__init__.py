"""Grounding: actions of the simulation that do what the policy's action would do in reality."""
