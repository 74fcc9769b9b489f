"""``python -m qdos_brax``: see ``python -m qdos_brax --help``."""

import sys

from qdos_brax.commands.main import main

if __name__ == "__main__":
    sys.exit(main())
