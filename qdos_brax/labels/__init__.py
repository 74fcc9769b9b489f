"""Pseudo-labels: which skill a segment played, what it earned, and how new it is to the learner."""
