"""Trainings that are judged as they go and can be taken up again, and the page of them."""
