"""Policies to call, on one observation or on many: read from a folder, or made from the caller's function."""

from __future__ import annotations

import dataclasses
import os
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax import user_code
from cuelearner_jax.api import arguments
from cuelearner_jax.api.worlds import World
from cuelearner_jax.environment import Quantity, actions_of, check_layout
from cuelearner_jax.errors import UserError
from cuelearner_jax.policies import Policy, call_policy, policy_name, policy_of
from cuelearner_jax.policies.foreign import FILES
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs import trained
from cuelearner_jax.spaces import DIRECTIONS, Space
from cuelearner_jax.task import Task, shape_of
from cuelearner_jax.tasks import registry, shipped
from cuelearner_jax.types import EnvState


@partial(jax.jit, static_argnames="space")
def _act(policy: Policy, key: PRNGKeyArray, obs: Float[Array, "n obs"], space: Space) -> Float[Array, "n action"]:
    return call_policy(policy, key, None, obs, space)


@dataclasses.dataclass(frozen=True)
class CallablePolicy:
    """A policy that can be called: `policy(obs)` on an observation (obs,), or on a batch (n, obs).

    `policy.policy` is the pytree behind it, `policy.act(key, states, obs)` what evaluation calls.
    """

    policy: Policy
    observation: tuple[Quantity, ...] = ()  # slices of the observation; empty: not known
    asks: bool = False  # True if the policy asks a teacher, who looks at the true state
    trained: RunConfig | None = None  # configuration of its training; None: not known
    actions: Space = DIRECTIONS  # space of its actions
    world: World | None = None  # world in which it was corrected, or loaded for; None: not known

    def __post_init__(self) -> None:
        """Make a policy of an object that acts. Raises UserError for any other."""
        object.__setattr__(self, "policy", policy_of(arguments.policy("policy", self.policy), self.actions))

    @user_code.report_user_errors
    def __call__(self, obs: Any, key: PRNGKeyArray | None = None) -> np.ndarray:
        """Return actions for observations.

        Args:
            obs: (obs,) or (n, obs), as `observation` orders them.
            key: for a policy that acts at random (default: always the same).

        Returns:
            Actions (action,) or (n, action); of directions unit vectors.

        Raises:
            UserError: observations of another size, numbers that are not finite, or a policy that asks a teacher.
        """
        if self.asks:
            raise UserError("this policy asks a teacher, who looks at the true state: call its act(key, states, obs)")
        rows = arguments.observations("obs", obs, sum(quantity.size for quantity in self.observation) or None)
        batch = rows[None] if rows.ndim == 1 else rows
        key = jax.random.key(0) if key is None else arguments.key("key", key)
        # A copy, which the caller may write in.
        chosen = np.array(_act(self.policy, key, jnp.asarray(batch), self.actions))
        user_code.check_actions(chosen, policy_name(self.policy))
        return chosen[0] if rows.ndim == 1 else chosen

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Act as `types.Policy.act`."""
        return self.policy.act(key, states, obs)


def as_policy(given: Any, name: str = "policy") -> Policy:
    """Return anything that acts as a policy: a `CallablePolicy`, a policy folder, or what `policies.policy_of` takes.

    Raises UserError, which says the argument's name, for what is none of them.
    """
    if isinstance(given, str | os.PathLike) and not str(given).endswith(FILES):
        try:
            given = load_policy(os.fspath(given))
        except UserError as error:
            raise UserError(f"{name}: {error}") from error
    return given.policy if isinstance(given, CallablePolicy) else arguments.policy(name, given)


def entries_of(policy: Any) -> int:
    """Return the number of entries of the observations that a policy expects, 0 where that is not known."""
    return sum(quantity.size for quantity in policy.observation) if isinstance(policy, CallablePolicy) else 0


def as_policy_in(given: Any, env: Any) -> Policy:
    """Return `as_policy` for a world. Raises UserError for a policy that cannot act there."""
    policy = as_policy(given)
    if isinstance(given, CallablePolicy) and given.observation:
        check_layout("the policy", given.observation, given.actions, env)
    policy = policy_of(policy, actions_of(env))
    user_code.acts_in("policy", policy, env)
    return policy


def source_of(policy: Any, world: World) -> trained.PolicySource:
    """Return a policy's source for a study in a world: the configuration of its training, or a stand-in."""
    config = getattr(policy, "trained", None) or world.task.start()
    return trained.PolicySource(world.task, dataclasses.replace(config, task=world.config), None, Path(world.task.name))


@user_code.report_user_errors
def load_policy(
    folder: str | os.PathLike[str],
    *,
    policy: str | None = None,
    guidance: str | None = None,
    labels: int | None = None,
    bound_deg: float | None = None,
    seed: int | None = None,
    base: Any = None,
    changes: Any = None,
    task: Task | str | None = None,
    world: World | None = None,
) -> CallablePolicy:
    """Load the policy of a lane of a finished run, or of a policy folder (`adapt`).

    Args:
        folder: folder of a run, of a sweep in pieces, or of a policy; or a shipped agent, as "shipped:navigation".
        policy: "agent", "guided" or another that `evaluate TASK --help` lists (default: the trained agent, or the
            adapted policy).
        guidance: the lane's kind of guidance (default: the run's last).
        labels: the lane's label budget (default: the largest).
        bound_deg: bound [deg] of a lane of a policy folder (default: the largest).
        seed: the lane's seed (default: the first).
        base: the policy that was adapted, where it is code: the folder names it, and does not hold it.
        changes: the distortions of your own that a reading corrected: the folder names them, and does not hold them.
        task: needed for a run of a task from outside the package, whose code is not loaded because a file names it.
        world: the world to act in, for policies that need more than observations (default: as it was trained).

    Raises:
        UserError: no such folder, lane or policy.
    """
    path = shipped.folder_of(str(arguments.path("folder", folder)))
    code = None if base is None else as_policy(base, "base")
    if isinstance(task, str):
        task = registry.resolve(task)
    if not path.exists():
        raise UserError(f"folder {path} does not exist: give the folder of a run, or of an adapted policy")
    find = lambda name: task if task and task.name == name else registry.find(name)  # noqa: E731
    source = trained.PolicySource.of_folder(path, find, code, changes)
    known, name = source.task, policy or source.default_policy
    changed = world.config if world else source.config.task
    source.check(name, changed)
    shape = shape_of(known, changed)
    found = trained.one_policy(source, changed, name, guidance, labels, seed, bound_deg)
    where = world or World(known, changed)
    taught = trained.POLICIES[name].taught
    return CallablePolicy(found, shape.observation, taught, source.config, actions_of(shape), where)
