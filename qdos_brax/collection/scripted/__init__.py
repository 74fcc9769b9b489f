"""Demonstrations by script, for tasks that no trained expert is shipped for."""
