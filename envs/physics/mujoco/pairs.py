"""List the pairs of geoms that can touch in the model, so that MuJoCo need not look for them in every step.

MuJoCo C finds them anew each time: it sorts the bodies along an axis, and descends trees of volumes. For a body among a
few walls that costs more than the contacts themselves. Listed pairs only pass a test of their bounding spheres. They
are listed in the order in which the search would find their contacts, and with the same properties, so that results
agree bit for bit.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np


def list_pairs(spec: mujoco.MjSpec) -> None:
    """Give ``spec`` its pairs of geoms that can touch, and take all others from MuJoCo's search (no contact bits)."""
    for k, geom in enumerate(spec.geoms):
        geom.name = geom.name or f"geom_{k}"
    model = spec.compile()
    for first, second in _pairs_that_can_touch(model):
        names = {"geomname1": model.geom(first).name, "geomname2": model.geom(second).name}
        spec.add_pair(**names, **_contact_properties(model, first, second))
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0


def _pairs_that_can_touch(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """Return pairs by their bits, not welded together, nor parent and child; in MuJoCo's order of contacts.

    That is by the two bodies, then by the two geoms, of which the one of the lower type comes first.
    """
    weld, parent = model.body_weldid, model.body_parentid
    types, bits, affinity = model.geom_type, model.geom_contype, model.geom_conaffinity
    found = []
    for a, b in zip(*np.triu_indices(model.ngeom, 1), strict=True):
        bodies = sorted((int(model.geom_bodyid[a]), int(model.geom_bodyid[b])))
        one, other = weld[bodies]
        kin = one == weld[parent[other]] or other == weld[parent[one]]
        if one == other or (kin and one and other) or not (bits[a] & affinity[b] or bits[b] & affinity[a]):
            continue
        geoms = (int(a), int(b)) if types[a] <= types[b] else (int(b), int(a))
        found.append((*bodies, *geoms))
    return [(first, second) for *_, first, second in sorted(found)]


def _contact_properties(model: mujoco.MjModel, first: int, second: int) -> dict[str, Any]:
    """Return the contact's properties: those of the geom with priority, else the mean or the greater."""
    geoms = np.array([first, second])
    priority = model.geom_priority[geoms]
    if priority[0] != priority[1]:
        geoms = geoms[[priority.argmax()]]
    sliding, torsion, rolling = model.geom_friction[geoms].max(axis=0)
    return {
        "condim": int(model.geom_condim[geoms].max()),
        "friction": [sliding, sliding, torsion, rolling, rolling],
        "solref": model.geom_solref[geoms].mean(axis=0),
        "solimp": model.geom_solimp[geoms].mean(axis=0),
        "margin": model.geom_margin[[first, second]].sum(),
        "gap": model.geom_gap[[first, second]].sum(),
    }
