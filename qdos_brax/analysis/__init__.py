"""Finished runs: loading, evaluating, filming, analysing, concluding."""
