"""MuJoCo Playground's dm_control tasks for our loop. The only module that imports `mujoco_playground`.

Written for playground 0.2.0. Its locomotion and manipulation tasks download their robots when they are made: they are
not offered by name, and `from_playground` takes one that the caller made.
"""

# pyright: reportMissingImports=false
from __future__ import annotations

from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cuelearner_jax.bridges.jax_environment import FixedSimulator, JaxEnvironment, layout_of, space_of
from cuelearner_jax.errors import UserError, suggestion
from cuelearner_jax.spaces import Cue


def suite() -> ModuleType:
    """Return Playground's dm_control suite. Raises UserError where Playground is not installed."""
    try:
        from mujoco_playground import dm_control_suite  # takes seconds to load
    except ModuleNotFoundError:
        raise UserError(
            "tasks of playground need the extra `playground`: pip install 'cuelearner-jax[playground]'"
        ) from None
    return dm_control_suite


def make(name: str) -> Any:
    """Return a dm_control task of Playground by its name, in MJX's JAX implementation.

    Raises:
        UserError: Playground is not installed, has no such task or cannot make it, or downloads its robot.
    """
    known = suite()
    if name not in known.ALL_ENVS:
        from mujoco_playground import registry

        if name in registry.ALL_ENVS:
            raise UserError(
                f"playground:{name} downloads its robot: make that environment yourself, and pass it to from_playground"
            )
        raise UserError(f"playground has no task {name!r}{suggestion(name, known.ALL_ENVS)}")
    try:
        with jax.ensure_compile_time_eval():  # a task holds arrays, and may be asked for while something is traced
            return known.load(name, config_overrides={"impl": "jax"})
    except AttributeError as error:  # MuJoCo's own interface has changed
        raise UserError(
            f"playground:{name} does not work with the installed MuJoCo ({error}): choose another task"
        ) from error


def from_playground(
    env: Any,
    to_action: Callable[[Float[Array, "2"]], Float[Array, " n"]] | None = None,
    max_steps: int = 1000,
    heuristic: Callable[[Float[Array, " obs"]], Float[Array, " action"]] | None = None,
    *,
    cues: Sequence[Cue] = (),
) -> JaxEnvironment:
    """Return a Playground environment (`mujoco_playground.MjxEnv`) as one of ours, with its whole action box.

    Arguments and errors are those of `bridges.brax.from_brax`. Observations of pixels are refused.
    """
    name = type(env.unwrapped).__name__
    layout = layout_of(env, name)
    return JaxEnvironment(
        max_steps=jnp.array(max_steps, jnp.int32),
        simulator=FixedSimulator(env),
        observation=layout.observation,
        actions=space_of(name, layout, to_action, cues),
        to_action=to_action,
        heuristic=heuristic,
    )
