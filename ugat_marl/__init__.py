"""Multi-agent traffic-signal environments across the gap between simulation and street."""
