"""The finished policy of a lane: the agent alone, or the agent with an arbiter that also acts after training."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

from cuelearner_jax.arbiters.protocol import Arbiter, Finishes, LaneParts, make_arbiter
from cuelearner_jax.config import Scalars
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.policies.layers import Agent, plain_part
from cuelearner_jax.policies.node import BY_LANE, SHARED, PolicyNode, describe
from cuelearner_jax.run_config import RunConfig, kind_to_json
from cuelearner_jax.types import EnvState, GuidanceModel, Params


class Arbitrated(PolicyNode):
    """A finished agent with an arbiter, which chooses by the arm that validated best."""

    base: Agent
    model: GuidanceModel
    scalars: Scalars
    options: Any  # options of the arbiter
    arm: Int[Array, "*lanes"]
    steps: Float[Array, ""]  # environment steps that the agent has learned from
    arbiter: Finishes = struct.field(pytree_node=False)
    guide: Guide = struct.field(pytree_node=False)

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Return the arm's choice of actions."""
        agent = self.base
        known = LaneParts(agent.view, agent.functions, agent.params, self.guide, self.model, self.scalars, self.steps)
        return self.arbiter.act(self.arm, self.options, known, obs, key)

    @property
    def axes(self) -> Arbitrated:
        """Lane axes: each lane has its own agent, model and arm; a single arm is shared by all lanes."""
        arm = SHARED if jnp.ndim(self.arm) == 0 else BY_LANE
        shared = dict.fromkeys(("scalars", "options", "steps"), SHARED)
        return self.replace(base=self.base.axes, model=BY_LANE, arm=arm, **shared)

    def describe(self) -> dict[str, Any]:
        """Return the arbiter, its arm (of a block each lane's), the guidance and the agent, as JSON values."""
        arms = [self.arbiter.arms[int(arm)] for arm in np.ravel(np.asarray(self.arm))]
        return {
            "policy": "arbitrated",
            "arbiter": {"name": self.options.NAME, **plain_part(type(self.options), self.options)},
            "arm": arms[0] if np.ndim(self.arm) == 0 else arms,
            "steps_learned_from": float(self.steps),
            "guidance": self.guide.name,
            "options": kind_to_json(self.guide.options),
            "scalars": plain_part(Scalars, self.scalars),
            "fitted": bool(np.all(self.model.fitted)),
            "base": describe(self.base),
        }


def arbiter_of(config: RunConfig) -> Arbiter:
    """Return the arbiter of a run."""
    return make_arbiter(config.arbiter, config.agent, config.bootstraps)


def acting_state(arbiter: Arbiter, params: Params, model: GuidanceModel, state: Any) -> dict[str, Any]:
    """Return the part of a lane that its finished policy needs, as checkpoints hold it for `final_policy`.

    `state`: the arbiter's state, whose arm is kept if the arbiter acts in the finished policy.
    """
    arm = {"arm": arbiter.arm(state)} if isinstance(arbiter, Finishes) else {}
    return {"params": params, "guidance": model, **arm}


def final_policy(config: RunConfig, guide: Guide, view: Any, step: int, known: Mapping[str, Any]) -> Agent | Arbitrated:
    """Return the lanes' policies as they stand after so many steps.

    Args:
        config: the run's configuration.
        guide: the guide of the lanes' kind of guidance.
        view: view of the world that the policy acts in.
        step: environment steps of each lane.
        known: the lanes' `acting_state` with a leading axis of lanes; one arm may serve all lanes.
    """
    agent = Agent(known["params"], config.agent_in(view), view)
    arbiter = arbiter_of(config)
    if not isinstance(arbiter, Finishes):
        return agent
    steps, arm = jnp.asarray(config.schedule.learned_from(step), jnp.float32), jnp.asarray(known["arm"])
    return Arbitrated(agent, known["guidance"], config.scalars, config.arbiter, arm, steps, arbiter, guide)
