"""Hold the layouts of OGBench 1.2.2: walls, and where there are any, teleporters."""

from __future__ import annotations

from dataclasses import dataclass

LAYOUTS = {
    "arena": """
        11111111
        10000001
        10000001
        10000001
        10000001
        10000001
        10000001
        11111111""",
    "medium": """
        11111111
        10011001
        10010001
        11000111
        10010001
        10100101
        10001001
        11111111""",
    "large": """
        111111111111
        100001000001
        101101010101
        100000010001
        101111011101
        100101000001
        110101010111
        100100010001
        111111111111""",
    "giant": """
        1111111111111111
        1010000001100001
        1010110101001101
        1000100100010001
        1011101111110101
        1000100010000101
        1110101001010111
        1000100100010001
        1010101111110101
        1011100010001101
        1000001000100001
        1111111111111111""",
    "teleport": """
        111111111111
        100000101001
        110100010011
        110111000001
        100001010101
        101101010101
        101101010101
        100001000101
        111111111111""",
}


@dataclass(frozen=True)
class Teleporters:
    """Name cells whose middle sends a body to one of a few others.

    Attributes:
        entrances: cells at whose centre a body, nearer than ``TELEPORT_REACH``, is sent off.
        exits: cells at whose centre it comes out, each as likely.
    """

    entrances: tuple[tuple[int, int], ...]
    exits: tuple[tuple[int, int], ...]


# The exit (1, 7) is a cell without a way out.
TELEPORTERS = {"teleport": Teleporters(entrances=((4, 6), (5, 1)), exits=((1, 7), (6, 1), (6, 10)))}
