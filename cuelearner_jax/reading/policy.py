"""A policy corrected by an estimated change, and by a process for what depends on the situation."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.policies import PolicyNode, describe
from cuelearner_jax.reading import linear, posterior
from cuelearner_jax.reading.families import Family, has_effects, unknowns_of
from cuelearner_jax.reading.linear import Change, ObservationFrame
from cuelearner_jax.spaces import Space
from cuelearner_jax.types import Actions, EnvState, Observations

KIND = "reading"


class Correction(struct.PyTreeNode):
    """The estimate of a change, and the process with which other errors are corrected."""

    change: Change
    frame: ObservationFrame
    known: Float[Array, "n z"]  # situations that the process was fitted in
    alpha: Float[Array, "n cues"]  # times its variance: weights of the situations
    length: Float[Array, " z"]  # length scale of each input of the process
    scale: Float[Array, ""]  # unit of changes, in the unit of `space.log`

    def more(self, space: Space, obs: Observations, action: Float[Array, "n a"]) -> Float[Array, "n cues"]:
        """Return the mean of the process, in units of `scale`; `action`: the base's."""
        inputs = linear.inputs(space, self.frame, obs, action)
        return posterior.correlation(self.length, inputs, self.known) @ self.alpha


def corrected(
    space: Space,
    family: Family,
    correction: Correction,
    obs: Observations,
    before: Observations,
    first: Actions,
    action: Actions,
) -> Actions:
    """Return corrected actions.

    `obs`, `before`: observations as they are, and as they would be without the change (`linear.undone`). `first`,
    `action`: what the policy does about the two. With recorded effects of the state, the process depends on the action
    about the shifted state in place of `first`: where the policy runs, it acts about that alone.
    """
    action = jnp.where(jnp.isfinite(action), action, first)  # as it was, where the other is none
    base = linear.meant(family, correction.change.theta, before, action)
    more = correction.more(space, obs, base if has_effects(family) else first)
    return space.exp(base, correction.scale * (linear.basis(space, base) @ correction.change.action.T + more))


class ReadingPolicy(PolicyNode):
    """Another policy, corrected; without a change it acts as its base."""

    base: Any  # a policy
    correction: Correction  # of a block: every leaf with a leading axis of lanes
    bound: Float[Array, ""]  # largest change along a cue, in the unit of `space.log`; infinite: none
    space: Space = struct.field(pytree_node=False)
    family: Family = struct.field(pytree_node=False)  # empty: shifts and mixings of entries
    reference: str = struct.field(pytree_node=False, default="")  # reference of the family's code; empty: declared

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Observations) -> Actions:
        """Return the base's actions, corrected."""
        first = self.base.act(key, states, obs)
        before = linear.undone(self.family, self.correction.change, obs)
        action = self.base.act(key, states, before)
        return _bounded(self.space, self.family, self.correction, self.bound, obs, before, first, action)

    @property
    def questions(self) -> int:
        """Number of observations that matter, 0 if only as met: undone, and for a bound or a process also as met."""
        own = self.correction
        if not (np.any(np.asarray(own.change.theta)) or np.any(np.asarray(own.change.mix))):
            return 0
        return 1 + bool((self._is_bounded or np.any(np.asarray(own.alpha))) and not has_effects(self.family))

    @property
    def _is_bounded(self) -> bool:
        return bool(np.any(np.asarray(self.bound) < np.asarray(self.space.from_unit(self.space.reach))))

    @property
    def LANES(self) -> tuple[str, ...]:
        """Each lane has its own correction where there is more than one."""
        return ("correction", "bound") if jnp.ndim(self.correction.scale) else ()

    def describe(self) -> dict[str, Any]:
        """Return the sizes of the correction's arrays, the family's unknowns with their values, and the base."""
        own, radius = self.correction, float(self.space.to_unit(np.max(self.bound), np))
        values = zip(unknowns_of(self.family), np.asarray(own.change.theta).T.tolist(), strict=False)
        return {
            "policy": KIND,
            "guidance": KIND,
            "changes": [{"name": one.name, "unit": one.unit, "value": value} for one, value in values],
            "distortions": [one.name for one in self.family],
            "code": self.reference,
            "labels": int(own.known.shape[-2]),
            "mixed": int(own.frame.mixed.shape[-1]),
            "base": describe(self.base),
            **({"bounded": True, "clip_radius_deg": radius} if self._is_bounded else {}),
        }


# Compiled apart from the base, which may be plain Python.
@partial(jax.jit, static_argnums=(0, 1))
def _bounded(space: Space, family: Family, correction: Correction, bound: Array, obs: Array, *rest: Array) -> Actions:
    """Return corrected actions, within a bound of the base's; `rest`: what `corrected` takes after `obs`."""
    around = linear.meant(family, correction.change.theta, rest[0], rest[2]) if has_effects(family) else rest[1]
    return space.clip(corrected(space, family, correction, obs, *rest), around, bound)


def unread(
    base: Any, space: Space, family: Family, obs_size: int, labels: int = 0, mixed: int = 0, reference: str = ""
) -> ReadingPolicy:
    """Return a policy without a correction, with arrays of the shapes that `describe` tells."""
    change, zeros = linear.no_change(space, family, obs_size), jnp.zeros
    z = obs_size + space.size
    step = zeros(linear.unknowns(family, obs_size))
    frame = ObservationFrame(zeros(obs_size), jnp.ones(obs_size), zeros(obs_size), step, zeros(mixed, jnp.int32))
    known, alpha = zeros((labels, z)), zeros((labels, len(space.cues)))
    correction = Correction(change, frame, known, alpha, jnp.ones(z), jnp.float32(0))
    return ReadingPolicy(base, correction, jnp.float32(jnp.inf), space, family, reference)
