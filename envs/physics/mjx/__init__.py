"""MJX: the physics on an accelerator, in jax or in MuJoCo Warp."""
