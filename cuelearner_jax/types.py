"""Every record that flows through the system, with the shape and unit of each field, and the protocols.

Records describe one sample or one seed; leading axes appear only where code is vmapped.
Directions are unit vectors in the plane; angles are radians, counterclockwise positive.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

Params = Any  # a Flax parameter pytree
EnvState = Any  # whatever pytree an environment carries from step to step


class Step(struct.PyTreeNode):
    """What one environment step returns."""

    obs: Float[Array, " obs"]  # to act on next: after the automatic reset where the episode ended
    final_obs: Float[Array, " obs"]  # what the action led to: before the automatic reset
    aftermath: Float[Array, " aftermath"]  # what replay keeps of `final_obs`, see `Environment.recall_next`
    reward: Float[Array, ""]
    terminated: Bool[Array, ""]  # the task ended: nothing follows
    truncated: Bool[Array, ""]  # time ran out: something would have followed
    metrics: Mapping[str, Float[Array, ""]]  # averaged over steps in every report
    outcome: Mapping[str, Float[Array, ""]]  # averaged over episodes: counts where an episode ends


class Teacher(Protocol):
    """Knows (or believes it knows) the best action. A pytree, like an environment."""

    def best_action(self, state: EnvState, obs: Float[Array, " obs"]) -> Float[Array, "2"]:
        """The direction that the teacher would choose."""
        ...


class Memory(struct.PyTreeNode):
    """One stored step, as small as the environment can make it."""

    obs: Float[Array, " memory"]  # see `Environment.remember`
    action: Float[Array, "2"]  # as executed
    reward: Float[Array, ""]
    discount: Float[Array, " 1_or_0"]  # this and the next two have no entries where nothing bootstraps
    ended: Float[Array, " 1_or_0"]  # 1 where the episode ended, terminated or truncated
    aftermath: Float[Array, " aftermath_or_0"]  # see `Environment.recall_next`


class Transition(struct.PyTreeNode):
    """One step to learn from. `next_obs` has no entries where nothing bootstraps from it (discount 0)."""

    obs: Float[Array, " obs"]
    action: Float[Array, "2"]  # as executed
    reward: Float[Array, ""]
    discount: Float[Array, ""]  # of `next_obs`: 0 at termination, never at truncation; 1 after one step
    next_obs: Float[Array, " obs_or_0"]


class Label(struct.PyTreeNode):
    """One answer of a teacher."""

    obs: Float[Array, " obs"]
    action: Float[Array, "2"]  # the action asked about
    target: Float[Array, "2"]  # what the guidance model is to predict; relative: rotate(action, eps * h) - action
    valid: Bool[Array, ""]  # False: padding, past this lane's budget, or no answer


class GuidanceModel(struct.PyTreeNode):
    """A guidance's learned part."""

    params: Params
    fitted: Bool[Array, ""]  # False until labels have been fitted: the model then leaves actions alone


class Asking(struct.PyTreeNode):
    """The table at which the teacher is asked, and its answers so far."""

    env: EnvState
    obs: Float[Array, " obs"]
    labels: Label  # leading axis: the largest budget of the sweep
    budget: Int[Array, ""]  # labels that this lane may use


class TrainState(struct.PyTreeNode):
    """One lane's everything: a lane is one seed with one label budget."""

    params: Params
    target_params: Params  # None where nothing bootstraps (discount 0)
    opt_state: Any
    replay: Float[Array, "capacity width"]
    guidance: GuidanceModel
    asking: Asking
    env: EnvState  # leading axis: num_envs
    obs: Float[Array, "num_envs obs"]
    guided: Bool[Array, " num_envs"]  # is the running episode a guided one?
    key: PRNGKeyArray


class Clock(struct.PyTreeNode):
    """Counters shared by all lanes: never vmapped, so that branches on them stay branches."""

    step: Int[Array, ""]  # environment steps of each lane
    update: Int[Array, ""]  # gradient steps of each lane
    round: Int[Array, ""]  # label rounds of each lane


class Guidance(NamedTuple):
    """One form of guidance: a bundle of pure functions, chosen in Python before tracing."""

    name: str
    asks: bool  # does it ask a teacher for labels?
    init: Callable[[PRNGKeyArray], GuidanceModel]
    label: Callable[..., tuple[Float[Array, "2"], Bool[Array, ""]]]  # (key, action, best, scalars) -> target, valid
    fit: Callable[..., GuidanceModel]  # (key, env, labels, scalars) -> model
    act: Callable[..., Any]  # (model, env, obs (n, obs), actions (n, 2), active (n,), scalars) -> refine.Refined
