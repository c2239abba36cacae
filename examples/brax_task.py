"""A brax environment as a task of one's own: an inverted pendulum on a cart, pushed right or left.

`brax:inverted_pendulum` is that environment by name. This task adds words for the push and the obvious action.
Nobody answers here, so kinds of guidance that ask a teacher are refused; the obvious action, pushing to where the pole
leans, can guide. Run in the folder above this one:

    cuelearner train examples.brax_task:TASK --guidance heuristic --out runs/pendulum
    cuelearner evaluate runs/pendulum --task examples.brax_task:TASK --episodes 10
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
from brax import envs
from jaxtyping import Array, Float

from cuelearner_jax.agents import ddqn
from cuelearner_jax.arbiters import Paced
from cuelearner_jax.bridges.brax import JaxEnvironment, from_brax
from cuelearner_jax.config import EPISODE, Scalars, Schedule, Sizes, check_part
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.spaces import Cue
from cuelearner_jax.task import Body, Preset, Task

PUSH = Cue("push", ("right", "left"), ("ArrowRight", "ArrowLeft"), "shares")


@dataclass(frozen=True)
class PendulumConfig:
    """An inverted pendulum. Every field is an option `--task.…`, the line below it its help."""

    max_steps: Annotated[int, EPISODE] = 200
    """Steps after which an episode is truncated."""
    backend: Literal["spring", "positional", "generalized"] = "spring"
    """Physics backend of brax."""


@cache
def _made(backend: str) -> envs.Env:
    """Return one object for each physics: it is a compilation constant, so another object compiles again."""
    with jax.ensure_compile_time_eval():  # it holds arrays, and may be asked for while something is traced
        return envs.get_environment("inverted_pendulum", backend=backend)


def toward_the_lean(obs: Float[Array, " obs"]) -> Float[Array, "1"]:
    """The obvious action: push the cart to where the pole leans (the second entry is its angle)."""
    return jnp.where(obs[1:2] > 0, 1.0, -1.0)


def make_environment(config: PendulumConfig, split: str = "training") -> JaxEnvironment:
    """The environment of a configuration."""
    check_part(config, "task")
    return from_brax(_made(config.backend), max_steps=config.max_steps, heuristic=toward_the_lean, cues=(PUSH,))


TASK = Task(
    name="pendulum",
    about="brax's inverted pendulum: a push a step keeps the pole up",
    config=PendulumConfig,
    bodies=(Body("cart", "brax's own", make_environment),),
    longest=lambda config: config.max_steps,
    presets={
        "quickstart": Preset(
            "small networks: a minute or two on two CPU cores",
            RunConfig(
                PendulumConfig(),
                Sizes(num_envs=10),
                Scalars(discount=0.95, max_grad_norm=10.0),
                Schedule(
                    total_steps=4_000,
                    random_steps=500,
                    learn_after=500,
                    guidance_until=2_000,
                    eval_every=1_000,
                    eval_steps=2_000,
                    eval_envs=10,
                    checkpoint_every=2_000,
                ),
                ddqn.DDQNConfig(
                    q_layers=(64, 64),
                    directions=12,
                    target_directions=12,
                    batch_size=64,
                    replay_capacity=20_000,
                    optimizer="adam",
                    learning_rate=0.003,
                    polyak=0.05,
                ),
                Paced(),
            ),
            seeds=2,
        )
    },
)
