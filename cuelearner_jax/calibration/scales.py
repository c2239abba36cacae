"""Prior scales of unknowns: so large that a change moves a policy's actions by a few answers' strength."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from cuelearner_jax.calibration.families import Family
from cuelearner_jax.calibration.meaning import Meaning

Floats = np.ndarray
CHANGED_BY = 10.0  # [eps]: the mean change of the policy's actions
MOST = 1 / 4  # largest mean change, as a share of the space's reach
SITUATIONS = 16
SIZES = np.geomspace(1e-4, 1e3, 29)  # scales that are tried, in the unknown's unit


def scales_of(meaning: Meaning, family: Family, obs: Float[Floats, "n obs"], eps: float) -> dict[str, float]:
    """Return the scale of each unknown by its name: the given one, or one found from the policy's actions."""
    obs = obs[:: max(1, len(obs) // SITUATIONS)][:SITUATIONS]
    target = min(CHANGED_BY * eps, float(meaning.space.from_unit(MOST * meaning.space.reach)))
    found = {}
    for distortion in family:
        for place, unknown in enumerate(distortion.unknowns):
            if unknown.scale is not None:
                found[unknown.name] = unknown.scale
                continue
            sizes = SIZES[max(unknown.most / 4, SIZES[0]) >= SIZES]
            thetas = np.zeros((1 + len(sizes), len(distortion.unknowns)))
            thetas[1:, place] = sizes
            meant = meaning.right((distortion,), thetas, _seen_by(meaning, (distortion,), thetas, obs))
            moved = np.abs(meaning.offsets((), np.zeros((len(sizes), 0)), meant[1:], meant[0])).max(-1)
            moved = np.minimum(moved, 3 * target).mean(1)
            enough = np.flatnonzero(moved >= min(target, 0.5 * max(moved.max(), 1e-12)))
            found[unknown.name] = float(sizes[enough[0]]) if moved.max() > 0 else float(sizes[-1])
    return found


def _seen_by(meaning: Meaning, family: Family, thetas: Floats, obs: Floats) -> Floats:
    if family[0].asks:
        return meaning.actions(family, thetas, obs)
    return np.broadcast_to(meaning.actions((), thetas[:1, :0], obs), (len(thetas), len(obs), meaning.space.size))
