"""The bandit as a task that a page can show: a disc, and where the context lies."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import probes

from cuelearner_jax.task import Body, Pictures, Preset, Task
from cuelearner_jax.types import Reel, Sketch


def sketch(env, state):
    """A unit disc with a dot where the context is; the arrow begins in the middle."""
    x, y = np.asarray(state, float)
    places = {"dot": (float(x), -float(y), 0.0)}
    return Sketch((-2, -2, 4, 4), "<circle r='1'/>", {"dot": "<circle r='0.1'/>"}, places, (0.0, 0.0), (0.0, 1.0), 0.0)


@jax.jit
def _won(env, state, action):
    return env.step(jax.random.key(0), state, action)[1].reward


def reel(env, state, action):
    """The dot goes out where the action wins."""
    x, y = np.asarray(state, float)
    won = bool(_won(env, state, jnp.asarray(action)))
    return Reel(0.05, [{"dot": (float(x), -float(y), 0.0)}, {"dot": None if won else (0.0, 0.0, 0.0)}], str(won))


class Wandering(probes.Window):
    """The bandit, whose next context is the observation turned by the action: a session's way can be told by hand."""

    def step(self, key, state, action):
        _, step = super().step(key, state, action)
        turned = probes.rotate(state, jnp.arctan2(action[1], action[0]))
        return turned, step.replace(obs=turned)


def _world(config, split):
    return Wandering(jnp.deg2rad(jnp.array(config.half_width_deg)), contexts=8)


PICTURES = Pictures(None, None, None, None, sketch, reel)  # pyright: ignore[reportArgumentType]
TASK = Task(
    "wandering",
    "the bandit with a page",
    probes.WindowConfig,
    (Body("point", "", _world, pictures=lambda: PICTURES),),
    teacher=lambda config, env: probes.Expert(env),
    presets={"paper": Preset("tiny", dataclasses.replace(probes.CONFIG), guidance=("relative",), labels=(20,))},
)


def left_of(obs):
    """A policy: a quarter turn counterclockwise of what is seen."""
    return np.stack([-obs[:, 1], obs[:, 0]], axis=-1)
