"""Networks, distributions and the optimiser step: no losses, no data."""
