"""Where simulation and measurement disagree, which effect is missing, and the gap without it."""
