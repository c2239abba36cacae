"""Pictures of a policy at work: a still and a film, or the first situation as a person is asked about it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax import user_code
from cuelearner_jax.environment import Environment, actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import episodes
from cuelearner_jax.policies import Policy, call_policy, policy_name
from cuelearner_jax.spaces import Space
from cuelearner_jax.task import Pictures
from cuelearner_jax.types import EnvState

FILMS = ("gif", "mp4")


class Files(NamedTuple):
    """Where the pictures of a policy go."""

    film: Path
    still: Path
    question: Path


def files(folder: Path, name: str, film: str) -> Files:
    """The files of a name in a folder. Raises UserError for a kind of film that there is not."""
    if film not in FILMS:
        raise UserError(f"--film is {film!r}: choose gif or mp4")
    return Files(folder / f"{name}.{film}", folder / f"{name}.png", folder / f"{name}-question.png")


def check_free(*wanted: Path, overwrite: bool) -> None:
    """Raises UserError if one of the files is there already and may not be replaced."""
    for file in wanted:
        if file.exists() and not overwrite:
            raise UserError(f"{file} exists: give --overwrite to replace it, or another --out")


def film(pictures: Pictures, env: Environment, policy: Policy, episode: int, steps: int, to: Files) -> list[float]:
    """Writes a film and a still of some steps of a policy; a new episode follows the end of one.

    Args:
        pictures: how the environment is drawn.
        env: the world.
        policy: who acts.
        episode: which of the validation episodes is the first.
        steps: how many.
        to: where they go; folders are made.

    Returns:
        The reward of each step.

    Raises:
        UserError: the policy gave something else than actions; nothing has been written.
    """
    acting = _Watched(policy, actions_of(env))
    frames, rewards = pictures.record(env, acting, _start(episode), steps)
    jax.effects_barrier()
    user_code.check_actions(np.array(acting.sound, bool), policy_name(policy))
    to.film.parent.mkdir(parents=True, exist_ok=True)
    pictures.still(env, frames, to.still)
    pictures.animate(env, frames, to.film)
    return rewards


def question(pictures: Pictures, env: Environment, policy: Policy, episode: int, to: Path) -> None:
    """Writes a picture of the situation that a validation episode begins with, with the policy's action in question.

    Raises UserError, and writes nothing, if the policy gives something else than an action.
    """

    @jax.jit
    def first(env: Environment, key: jax.Array) -> tuple[Any, jax.Array, jax.Array]:
        k_reset, k_play = jax.random.split(key)
        k_act, _ = jax.random.split(jax.random.fold_in(k_play, 0))  # as a film draws its first step
        state, obs = env.reset(k_reset)
        states = jax.tree.map(lambda leaf: leaf[None], state)
        return state, obs, call_policy(policy, k_act, states, obs[None], actions_of(env))[0]

    state, obs, action = first(env, _start(episode))
    user_code.check_actions(action, policy_name(policy))
    to.parent.mkdir(parents=True, exist_ok=True)
    pictures.question(env, state, obs, action, to)


class _Watched:
    """A policy that takes note of whether it gave actions; films are drawn inside compiled programs."""

    def __init__(self, policy: Policy, actions: Space) -> None:
        self.policy, self.sound = policy, []
        self._actions = actions

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """What the policy does, NaN in place of what is no action."""
        chosen = call_policy(self.policy, key, states, obs, self._actions)
        jax.debug.callback(lambda sound: self.sound.append(bool(sound)), jnp.isfinite(chosen).all())
        return chosen


def _start(episode: int) -> jax.Array:
    return jax.random.fold_in(episodes(), episode)
