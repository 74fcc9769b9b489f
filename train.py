"""Train QDOS: ``python train.py --env antsoccer --alpha 0.3``; see ``python train.py --help``."""

import sys

from qdos_brax.commands.train import train_main

if __name__ == "__main__":
    sys.exit(train_main())
