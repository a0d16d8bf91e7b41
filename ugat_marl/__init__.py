"""Multi-agent traffic-signal environments across the gap between simulation and street."""

__version__ = "0.1.0"
