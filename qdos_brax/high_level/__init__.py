"""The high level: SAC with a critic ensemble, replay on the device, and the macro step it acts by."""
