"""Collecting offline data: the experts that act, the recipes they follow, and the default sets."""
