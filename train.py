"""Trains QDOS: ``python train.py --env antsoccer --alpha 0.3``; see ``python train.py --help``."""

import sys

from qdos_brax.commands.cli import train_main

if __name__ == "__main__":
    sys.exit(train_main())
