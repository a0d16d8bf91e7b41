"""The sealed blind test: hidden effects are drawn, measured, diagnosed and graded."""
