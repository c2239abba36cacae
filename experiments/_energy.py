"""CLIC as a correction of a finished policy: what adaptation is compared with.

The public code of CLIC learns one policy from its first correction on, and its energy knows nothing of another policy.
Here the energy also sees how far an action lies from what a finished policy did, along each cue and in units of eps.
A few labels tell that, where no energy of the situation can be learned from them. With a_0 what the policy did:

    E(s, a, log(a_0, a) / eps),  a <- argmin over b within tau_max of a_0 of E

It is a kind of guidance, so the program of adaptation runs it as it runs relative feedback; on the command line it is
named as `_energy:CorrectingEnergy`, with this folder on the path of Python.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from cuelearner_jax.config import GuideScalars
from cuelearner_jax.guides import clic
from cuelearner_jax.guides.fitting import GuideModel, guide_model
from cuelearner_jax.types import Params


class CorrectingEnergy(clic.Clic):
    """An energy that sees how far an action has been turned; labels keep what the policy did (`base`)."""

    name, sees_base = "clic-correction", True
    about = "an energy over corrections, low in the sets that labels leave possible"

    @cached_property
    def network(self) -> GuideModel:
        """The network, or ensemble, that sees the turns beside situation and action."""
        return guide_model(self.sizes, self.spaces, outputs=1, beside=len(self.spaces.actions.cues))

    def energy(
        self,
        env: Any,
        params: Params,
        obs: Float[Array, " obs"],
        actions: Float[Array, "m action"],
        base: Float[Array, " action"] | None,
        scalars: GuideScalars,
    ) -> Float[Array, " m"]:
        """Return E of actions in one situation in which a policy did `base` (None: the first of the actions)."""
        space = self.spaces.actions
        first = jnp.broadcast_to(actions[0] if base is None else base, actions.shape)
        turns = space.log(first, actions) / space.from_unit(scalars.eps_deg)
        return -self.network.predict(env, params, obs, jnp.concatenate([actions, turns], -1))[:, 0]

    def disagreement(
        self, model: Any, env: Any, obs: Float[Array, "n obs"], actions: Float[Array, "n action"]
    ) -> Float[Array, " n"]:
        """Variance of the members' energies of actions that nothing has turned."""
        still = jnp.zeros((len(actions), len(self.spaces.actions.cues)))
        return self.network.disagreement(env, model.params, obs, jnp.concatenate([actions, still], -1))
