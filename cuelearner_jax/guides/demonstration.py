"""Guidance by demonstrations: an auxiliary policy is cloned from the teacher's demonstrated actions.

Source: paper, section V-A ("train an auxiliary policy that imitates the human teacher") and appendix. After the first
fit, questions are about the auxiliary policy's own actions (DAgger: Ross, Gordon, Bagnell, 2011). On raw observations
the policy sees only the observation. In the action's frame it sees the situation from some direction and predicts its
action relative to that direction. It is trained from all directions, since the right action depends on none. It then
looks again from the action that it reached, until the action settles. For a label (s, a, a*), in any space:

    pi = argmin over f of sum over labels of |f(s) - a*|^2,      a <- clip(retract(pi(s)), a, tau_max)

and in the action's frame, where pi(s, a) = a + f(s, a), as many passes as `relative` may take.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.config import GuideScalars
from cuelearner_jax.feedback.answers import DEMONSTRATION
from cuelearner_jax.guides.base import Guide, Rows
from cuelearner_jax.guides.fitting import Example
from cuelearner_jax.guides.refining import Refinement
from cuelearner_jax.types import Actions, GuidanceModel, Observations, Params


class Demonstration(Guide):
    """A policy that is fitted to the demonstrated actions, and acts in the agent's place."""

    name, about = "demonstration", "a policy cloned from what the teacher shows"
    form, colour = DEMONSTRATION, "#009E73"

    @property
    def looks_again(self) -> bool:
        """Whether the policy's action depends on the action that the situation is seen from."""
        return self.sizes.frame == "action"

    def predict(self, env: Any, params: Params, obs: Observations, actions: Actions) -> Actions:
        """Return the policy's action, seen from `actions`."""
        start = actions if self.looks_again else self._middle(actions)
        return start + self.network.predict(env, params, obs, start)

    def augmented(self, key: PRNGKeyArray, batch: Example) -> Example:
        """Return a batch seen half from uniform directions, half from the actions asked about."""
        if not self.looks_again:
            return batch
        k_half, k_where = jax.random.split(key)
        half = jax.random.bernoulli(k_half, 0.5, (batch.action.shape[0], 1))
        anywhere = self.spaces.actions.sample(k_where, (batch.action.shape[0],))
        return batch.replace(action=jnp.where(half, anywhere, batch.action))

    def act(
        self, model: GuidanceModel, env: Any, obs: Observations, actions: Actions, active: Rows, scalars: GuideScalars
    ) -> Refinement:
        """Return the policy's action in place of a, in active rows of a fitted model, within the bound around a."""

        def phi(current: Actions) -> Actions:
            return self.predict(env, model.params, obs, current) - current

        return self.refined(phi, actions, active & model.fitted, scalars, k_max=None if self.looks_again else 1)

    def disagreement(self, model: GuidanceModel, env: Any, obs: Observations, actions: Actions) -> Float[Array, " n"]:
        """Return the variance of the members' vectors, summed over their entries."""
        return super().disagreement(model, env, obs, actions if self.looks_again else self._middle(actions))

    def _middle(self, like: Actions) -> Actions:
        """Return the middle of the space for every row; zeros where there is none."""
        middle = self.spaces.actions.middle()
        return jnp.zeros_like(like) if middle is None else jnp.broadcast_to(middle, like.shape)
