"""Pictures of Gymnasium environments: `render` of a spare instance that replays an episode's actions."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt8

from cuelearner_jax import pictures, user_code
from cuelearner_jax.bridges.gymnasium.environment import Episode, GymnasiumTask
from cuelearner_jax.bridges.gymnasium.pool import pool_of
from cuelearner_jax.task import Pictures
from cuelearner_jax.tasks import fetch_layout
from cuelearner_jax.types import Reel, Sketch

HELD = 5  # steps for which a clip holds an action, since one step is hardly visible
PERIOD = 0.1  # time between two frames of a clip [s]
FPS = 25.0  # of a film, one frame per step
STILLS, CLIPS, FILMS = 0, 1, 2  # spare instances by purpose; each continues from its state where that lies on the way

Frame = UInt8[np.ndarray, "height width 3"]


def frames_of(env: GymnasiumTask, slot: int, seed: int, actions: Any, first: int) -> list[Frame]:
    """Return pictures of an episode after its first `first` actions. Raises UserError where there are none."""
    rows = np.asarray(actions, np.float32).reshape(-1, env.actions.size)
    source = env.source
    if source.factory is None:
        source = dataclasses.replace(source, arguments=fetch_layout.picture_arguments(source.name, source.arguments))
    return pool_of(dataclasses.replace(source, drawn=True)).filmed(slot, seed, rows, first)


def _went(state: Episode) -> tuple[int, np.ndarray]:
    """Return the seed of an episode and its actions so far."""
    seed, steps, actions = jax.device_get((state.seed, state.steps, state.actions))
    return int(seed), np.asarray(actions)[: int(steps)]


def picture(env: GymnasiumTask, state: Episode) -> Frame:
    """Return a picture of a state. Raises UserError where the environment gives none."""
    seed, actions = _went(state)
    return frames_of(env, STILLS, seed, actions, len(actions))[-1]


def check(env: GymnasiumTask) -> None:
    """Raise UserError where the environment cannot be drawn."""
    frames_of(env, STILLS, 0, np.zeros((0, env.actions.size)), 0)


def sketch(env: GymnasiumTask, state: Episode) -> Sketch:
    """Return a sketch of a state for the labelling page."""
    found = pictures.sketch(picture(env, state), f"step {int(state.steps) + 1}")
    source = env.source
    return found if source.factory else found._replace(points=fetch_layout.points_of(source.name, source.arguments))


def reel(env: GymnasiumTask, state: Episode, action: Float[Array, " action"]) -> Reel:
    """Return a clip of holding an action for a few steps."""
    seed, actions = _went(state)
    held = np.repeat(np.asarray(action, np.float32)[None], HELD, 0)
    frames = frames_of(env, CLIPS, seed, np.concatenate([actions, held]), len(actions))
    return pictures.clip(frames, PERIOD, f"held for {len(frames) - 1} steps")


def record(env: GymnasiumTask, policy: Any, key: PRNGKeyArray, steps: int) -> tuple[list[Frame], list[float]]:
    """Return a picture before each step, one at the end, and each step's reward. Raises UserError as `picture`."""

    @jax.jit
    def play(env: GymnasiumTask, key: PRNGKeyArray) -> Any:
        k_reset, k_play = jax.random.split(key)

        def advance(carry: Any, number: Array) -> Any:
            state, obs = carry
            k_act, k_step = jax.random.split(jax.random.fold_in(k_play, number))
            action = policy.act(k_act, jax.tree.map(lambda leaf: leaf[None], state), obs[None])[0]
            after, step = env.step(k_step, state, action)
            return (after, step.obs), (state.seed, state.steps, action, step.reward)

        return jax.lax.scan(advance, env.reset(k_reset), jax.numpy.arange(steps))[1]

    seeds, places, actions, rewards = jax.device_get(play(env, key))
    user_code.tell()
    begins = np.flatnonzero(places == 0).tolist()
    frames = []
    for first, end in zip(begins, [*begins[1:], steps], strict=True):
        frames += frames_of(env, FILMS, int(seeds[first]), actions[first:end], 0)
    return frames, rewards.tolist()


def question(env: GymnasiumTask, state: Episode, obs: Any, action: Any, file: Path) -> None:
    """Write two pictures side by side: the state, and the state after holding the action."""
    seed, actions = _went(state)
    held = np.repeat(np.asarray(action, np.float32)[None], HELD, 0)
    frames = frames_of(env, CLIPS, seed, np.concatenate([actions, held]), len(actions))
    pictures.still([frames[0], frames[-1]], file)


PICTURES = Pictures(
    record=record,
    still=lambda env, frames, file: pictures.still(frames, file),
    animate=lambda env, frames, file: pictures.animate(frames, file, FPS),
    question=question,
    sketch=sketch,
    reel=reel,
    check=check,
)
