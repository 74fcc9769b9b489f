"""QDOS: advantage-weighted quality-diversity skills from offline data, then online learning over them."""

__version__ = "0.1.0"
