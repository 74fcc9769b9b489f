"""``python -m qdos_brax``: data, evaluate, report, tasks, doctor."""

import sys

from qdos_brax.commands.cli import main

if __name__ == "__main__":
    sys.exit(main())
