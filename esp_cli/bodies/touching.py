"""What a model may touch, and how: its shapes and contacts beside those of their images, though no state meets them."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.optimize import linear_sum_assignment

from esp_cli.bodies.deriving import Match
from esp_cli.bodies.frame import Frame, share
from esp_cli.bodies.reading import printable
from esp_cli.symmetry.elements import Floats

_OF_A_GEOM = ("friction", "solref", "solimp", "margin", "gap", "condim", "priority", "solmix", "adhesion")
_OF_A_PAIR = ("friction", "solref", "solimp", "margin", "gap", "dim", "solreffriction", "adhesion")


def shape_images(frame: Frame, R: Floats, b: int, c: int) -> list[tuple[int, int, float]]:
    """Return each shape of a moving body that may touch something, its image on another (-1: none), and their gap."""
    own, other = frame.shapes.get(b, []), frame.shapes.get(c, [])
    on_world = frame.touching[:, frame.model.body_weldid[frame.model.geom_bodyid] == 0].any(1)
    contacts = frame.properties("geom", *_OF_A_GEOM) | {"number": frame.touching.sum(1), "world": on_world}
    table = np.ones((len(own), len(other)))
    for row, (g, kind, place, spread) in zip(table, own, strict=True):
        for k, (h, like, there, extent) in enumerate(other):
            if like == kind:
                off = float(np.linalg.norm(R @ place - there)) / frame.size
                row[k] = min(max(off, share(R @ spread @ R.T, extent)), 0.99)  # rather than one of another type
                row[k] += 1e-9 * any(share(x[g], x[h]) > 0 for x in contacts.values())  # of two at one place
    found = {i: (other[k][0], float(table[i, k])) for i, k in zip(*linear_sum_assignment(table), strict=True)}
    return [(g, *found.get(i, (-1, 1.0))) for i, (g, *_) in enumerate(own)]


def unlike_contacts(frame: Frame, match: Match, wrong: float) -> tuple[str, ...]:
    """Return what may touch otherwise than its image, by a share of more than `wrong`."""
    model, image = frame.model, np.where(match.bodies.any(0), match.bodies.argmax(0), -1)
    image[0] = 0
    geoms, found, contacts = np.full(model.ngeom, -1), list[str](), frame.properties("geom", *_OF_A_GEOM)
    for b in frame.shapes:
        for g, h, gap in shape_images(frame, match.world, b, int(image[b])):
            geoms[g] = h
            unlike = ["shape"] * (gap > wrong)
            unlike += [what for what, x in contacts.items() if h >= 0 and share(x[g], x[h]) > wrong]
            found += [f"{what} of {_name(frame, g)}" for what in unlike]
            is_field = model.geom_type[g] == mujoco.mjtGeom.mjGEOM_HFIELD
            found += [f"shape of {_name(frame, g)} (not covered: of a height field its box alone is)"] * is_field
    known = np.flatnonzero(geoms >= 0)
    lost = frame.touching[np.ix_(known, known)] & ~frame.touching[np.ix_(geoms[known], geoms[known])]
    apart = sorted({tuple(sorted(model.geom_bodyid[known[list(pair)]].tolist())) for pair in np.argwhere(lost)})
    found += ["contact of " + " and ".join(printable(frame.name("body", b)) for b in pair) for pair in apart]
    pairs = {frozenset(pair): k for k, pair in enumerate(zip(model.pair_geom1, model.pair_geom2, strict=True))}
    for pair, k in pairs.items():
        other = pairs.get(frozenset(geoms[list(pair)]))
        if other is None or any(share(x[k], x[other]) > wrong for x in frame.properties("pair", *_OF_A_PAIR).values()):
            found.append("contact pair of " + " and ".join(_name(frame, g) for g in sorted(pair)))
    return tuple(found)


def _name(frame: Frame, geom: int) -> str:
    body = frame.name("body", int(frame.model.geom_bodyid[geom]))
    return printable(frame.model.geom(geom).name or f"geom#{geom} of {body}")
