"""Draw the pictures of docs/concepts.md, which lie beside it: ``python tools/concept_pictures.py``."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from qdos_brax.files import write_text

DOCS = Path(__file__).resolve().parents[1] / "docs"
LINE, INK, SOFT = 20, "#1b1f24", "#5b6470"
OFFLINE, ONLINE, DATA = "#e3eef7", "#e2f3ec", "#f5f0e3"


def box(x: int, y: int, width: int, height: int, lines: Sequence[str], colour: str) -> str:
    """Return a box with a bold first line and more lines below it, all in its middle."""
    top = y + height / 2 - LINE * (len(lines) - 1) / 2 + 5
    middle = f'x="{x + width / 2:g}" text-anchor="middle"'
    styles = ['font-weight="600"', *[f'fill="{SOFT}"'] * (len(lines) - 1)]
    texts = [
        f'<text {middle} y="{top + i * LINE:g}" {style}>{escape(line)}</text>'
        for i, (line, style) in enumerate(zip(lines, styles, strict=True))
    ]
    frame = f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="8" fill="{colour}" stroke="{SOFT}"/>'
    return "\n".join([frame, *texts])


def arrow(*points: tuple[int, int], label: str = "", at: tuple[int, int] = (0, 0)) -> str:
    """Return a line through points with a head at its end, and a label whose middle is ``at``."""
    path = " L".join(f"{x} {y}" for x, y in points)
    text = f'<text x="{at[0]}" y="{at[1]}" text-anchor="middle" fill="{SOFT}">{escape(label)}</text>' if label else ""
    return f'<path d="M{path}" fill="none" stroke="{INK}" stroke-width="1.5" marker-end="url(#head)"/>{text}'


def picture(width: int, height: int, title: str, parts: Sequence[str]) -> str:
    """Return an SVG file."""
    head = (
        '<marker id="head" markerWidth="9" markerHeight="8" refX="8" refY="4" orient="auto"><path d="M0 0 L9 4 L0 8z"/>'
    )
    return "\n".join([
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}"',
        f'  font-family="system-ui, sans-serif" font-size="14" fill="{INK}" role="img" aria-label="{escape(title)}">',
        f"<title>{escape(title)}</title>",
        f"<defs>{head}</marker></defs>",
        f'<rect width="{width}" height="{height}" fill="#fff"/>',
        *parts,
        "</svg>\n",
    ])  # fmt: skip


def method() -> str:
    """Return the picture of a run: what is learned from the data, and what online."""
    title = "Values weigh segments, skills are learned from them, SAC learns online which skill to play"
    return picture(900, 390, title, [
        box(20, 40, 200, 84, ["mixed data", "good moves, failures,", "noise"], DATA),
        box(260, 40, 180, 84, ["1 values", "how far is each state", "from success?"], OFFLINE),
        box(470, 40, 200, 84, ["weights", "exp(advantage / lambda)", "of each segment"], OFFLINE),
        box(700, 40, 180, 84, ["2 skills", "trajectory VAE:", "a latent z for H steps"], OFFLINE),
        box(480, 190, 180, 64, ["information term", "alpha keeps skills apart"], OFFLINE),
        box(20, 190, 420, 64, ["3 labels", "skill, reward and novelty of each logged segment"], OFFLINE),
        box(20, 300, 420, 70, ["4 online: SAC over skills", "batches: half labels, half replay"], ONLINE),
        box(700, 300, 180, 70, ["environment", "H steps per decision"], DATA),
        arrow((220, 82), (258, 82)),
        arrow((440, 82), (468, 82)),
        arrow((670, 82), (698, 82)),
        arrow((660, 222), (790, 222), (790, 127)),
        arrow((120, 124), (120, 188)),
        arrow((820, 124), (820, 298), label="the decoder acts", at=(740, 285)),
        arrow((230, 254), (230, 298)),
        arrow((440, 335), (698, 335), label="z", at=(570, 330)),
        arrow((700, 355), (443, 355), label="reward, next state", at=(570, 372)),
    ])  # fmt: skip


def macro_step() -> str:
    """Return the picture of an episode: a decision every H steps, each one transition of the high level."""
    parts = []
    for i in range(3):
        x = 110 + 250 * i
        parts.append(box(x, 20, 240, 34, [f"decision {i + 1}: latent z{'₁₂₃'[i]}"], ONLINE))
        parts += [
            f'<rect x="{x + 24 * k}" y="78" width="22" height="30" rx="3" fill="{OFFLINE}" stroke="{SOFT}"/>'
            for k in range(10)
        ]
        parts.append(arrow((x + 120, 54), (x + 120, 76)))
        told = "one transition: s, z, r, next s"
        parts.append(f'<text x="{x + 120}" y="134" text-anchor="middle" fill="{SOFT}">{told}</text>')
    parts += [
        f'<text x="14" y="42" fill="{SOFT}">high level</text>',
        f'<text x="14" y="98" fill="{SOFT}">environment</text>',
    ]
    return picture(900, 150, "Every H environment steps the high level chooses a skill", parts)


PICTURES = {"method.svg": method, "macro-step.svg": macro_step}

if __name__ == "__main__":
    for name, draw in PICTURES.items():
        write_text(DOCS / name, draw())
