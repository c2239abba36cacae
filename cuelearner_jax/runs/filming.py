"""Pictures of a policy at work: a film with a still, or a situation as the labelling page shows it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax

from cuelearner_jax import user_code
from cuelearner_jax.environment import Environment, actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import episodes
from cuelearner_jax.policies import Policy, call_policy, policy_name
from cuelearner_jax.task import Pictures

FILMS = ("gif", "mp4")


def files(folder: Path, name: str, film: str) -> tuple[Path, Path, Path]:
    """Return the paths of a name's film, still and question in a folder. Raises UserError for an unknown format."""
    if film not in FILMS:
        raise UserError(f"--film is {film!r}: choose gif or mp4")
    return folder / f"{name}.{film}", folder / f"{name}.png", folder / f"{name}-question.png"


def film(pictures: Pictures, env: Environment, policy: Policy, episode: int, steps: int, *to: Path) -> list[float]:
    """Write a film and a still (`to`) of a policy's steps from a validation episode on; return each step's reward.

    As many episodes are played as needed. Raises UserError, and writes nothing, if the first action is not finite.
    """
    _first(env, policy, episode)
    frames, rewards = pictures.record(env, policy, _start(episode), steps)
    animation, still = to
    still.parent.mkdir(parents=True, exist_ok=True)
    pictures.still(env, frames, still)
    pictures.animate(env, frames, animation)
    return rewards


def question(pictures: Pictures, env: Environment, policy: Policy, episode: int, to: Path) -> None:
    """Write a picture of a validation episode's first situation and the policy's action, if that action is finite."""
    state, obs, action = _first(env, policy, episode)
    to.parent.mkdir(parents=True, exist_ok=True)
    pictures.question(env, state, obs, action, to)


def _first(env: Environment, policy: Policy, episode: int) -> tuple[Any, jax.Array, jax.Array]:
    """Return an episode's first state, observation and action. Raises UserError unless the action is finite."""

    @jax.jit
    def first(env: Environment, key: jax.Array) -> tuple[Any, jax.Array, jax.Array]:
        k_reset, k_play = jax.random.split(key)
        k_act, _ = jax.random.split(jax.random.fold_in(k_play, 0))  # the same key as the first step of a film
        state, obs = env.reset(k_reset)
        states = jax.tree.map(lambda leaf: leaf[None], state)
        return state, obs, call_policy(policy, k_act, states, obs[None], actions_of(env))[0]

    state, obs, action = first(env, _start(episode))
    user_code.check_actions(action, policy_name(policy))
    return state, obs, action


def _start(episode: int) -> jax.Array:
    return jax.random.fold_in(episodes(), episode)
