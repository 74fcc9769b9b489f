"""Collecting data of manipulation tasks: scripted demonstrators that play in many simulations at once."""
