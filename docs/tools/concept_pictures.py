"""Draw the pictures of docs/concepts.md, which lie beside it: ``python docs/tools/concept_pictures.py``."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from qdos_brax.files import write_text

DOCS = Path(__file__).resolve().parents[1]
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
    """Return the picture of a run: what is learned from the data, and what online; narrow, for a phone."""
    title = "Values weigh segments, skills are learned from them, SAC learns online which skill to play"
    return picture(500, 512, title, [
        box(20, 20, 460, 50, ["mixed data", "good moves, failures, noise"], DATA),
        box(20, 110, 220, 64, ["1 values", "how far from success?"], OFFLINE),
        box(260, 110, 220, 64, ["weights of segments", "exp(advantage / lambda)"], OFFLINE),
        box(20, 214, 220, 64, ["information term", "alpha keeps skills apart"], OFFLINE),
        box(260, 214, 220, 64, ["2 skills", "trajectory VAE: latents z"], OFFLINE),
        box(20, 318, 460, 50, ["3 labels", "skill, reward and novelty of each logged segment"], OFFLINE),
        box(20, 408, 220, 84, ["4 online: SAC", "batches: half labels,", "half replay"], ONLINE),
        box(320, 408, 160, 84, ["environment", "the decoder acts", "for H steps"], DATA),
        arrow((130, 70), (130, 108)),
        arrow((240, 142), (258, 142)),
        arrow((370, 174), (370, 212)),
        arrow((240, 246), (258, 246)),
        arrow((370, 278), (370, 316)),
        arrow((130, 368), (130, 406)),
        arrow((240, 435), (318, 435), label="z", at=(280, 428)),
        arrow((320, 465), (243, 465), label="reward", at=(282, 484)),
    ])  # fmt: skip


def macro_step() -> str:
    """Return the picture of an episode: a decision every H steps, each one transition of the high level."""
    parts = []
    for i in range(2):
        x = 104 + 196 * i
        parts.append(box(x, 16, 186, 34, [f"decision {i + 1}: latent z{'₁₂'[i]}"], ONLINE))
        parts += [
            f'<rect x="{x + 21 * k}" y="76" width="18" height="30" rx="3" fill="{OFFLINE}" stroke="{SOFT}"/>'
            for k in range(9)
        ]
        parts.append(arrow((x + 93, 50), (x + 93, 74)))
        told = escape("one transition: s, z, r, s'")
        parts.append(f'<text x="{x + 93}" y="130" text-anchor="middle" fill="{SOFT}">{told}</text>')
    parts += [
        f'<text x="10" y="38" fill="{SOFT}">high level</text>',
        f'<text x="10" y="96" fill="{SOFT}">environment</text>',
    ]
    return picture(500, 146, "Every H environment steps the high level chooses a skill", parts)


PICTURES = {"method.svg": method, "macro-step.svg": macro_step}

if __name__ == "__main__":
    for name, draw in PICTURES.items():
        write_text(DOCS / name, draw())
