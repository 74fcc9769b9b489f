"""Manipulation tasks. Their models come from packages of the extra ``manipulation``."""
