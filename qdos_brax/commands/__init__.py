"""The command line: ``train.py`` and ``python -m qdos_brax``."""
