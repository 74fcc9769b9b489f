"""MuJoCo C: the exact engine, and what shapes a model for it."""
