"""Finished runs: loading, evaluating, filming, and looking inside."""
