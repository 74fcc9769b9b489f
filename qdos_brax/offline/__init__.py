"""Learners that need nothing but the data, and the one phase that trains any of them."""
