"""Learned teachers: the best direction by a network's values of the environment's features; and their folders.

A folder holds the network in half precision, and teacher.json: what the teacher is and how it was made. A teacher is
right in the world that it learned in. Before loading one for another world, call `world_of`.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Collection
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.agents.networks import all_finite, as_function, network_inputs, q_network
from cuelearner_jax.config import from_json, to_json
from cuelearner_jax.errors import NotFinite, UserError
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.spaces import directions as geometry
from cuelearner_jax.storage import formats
from cuelearner_jax.storage.checkpoint import Checkpoints
from cuelearner_jax.types import Number, Observation, Params

ABOUT = "teacher.json"
TRAIN = "python experiments/train_teacher.py"  # folder of the repository, for messages


def init_params(layers: tuple[int, ...], env: Any, key: PRNGKeyArray) -> Params:
    """Return random weights of a teacher's network."""
    obs, action = jnp.zeros(env.obs_size), jnp.array([1.0, 0.0])
    return q_network(layers).init(key, *network_inputs("action", DIRECTIONS, env, obs, action))


def expected_reward(
    layers: tuple[int, ...], env: Any, params: Params, obs: Observation, actions: Float[Array, "*n 2"]
) -> Float[Array, "*n"]:
    """Return the reward that a teacher's network expects of actions in one situation."""
    return as_function(q_network(layers))(params, *network_inputs("action", DIRECTIONS, env, obs, actions))[..., 0]


class LearnedTeacher(struct.PyTreeNode):
    """A teacher by a network's values of directions (`cuelearner_jax.types.Teacher`); it sees the observation alone."""

    env: Any  # the environment or view whose features the network sees
    params: Params
    aim_error: Float[Array, ""] | float  # standard deviation of the error of a player's aim [rad]
    habit: Number  # settles near-ties, see `actions.best_direction`
    layers: tuple[int, ...] = struct.field(pytree_node=False)
    directions: int = struct.field(pytree_node=False)

    def values(self, obs: Observation, options: Float[Array, "n 2"]) -> Float[Array, " n"]:
        """Return the expected reward of each direction."""
        return expected_reward(self.layers, self.env, self.params, obs, options)

    def best_action(self, state: Any, obs: Observation) -> Float[Array, "2"]:
        """Return the direction with the largest value."""
        values = self.values(obs, geometry.evenly_spaced(self.directions))
        return geometry.best_direction(values, self.aim_error, self.habit)

    def nearest_good(
        self, state: Any, obs: Observation, action: Float[Array, "2"], spread: Number, share: Number
    ) -> Float[Array, "2"]:
        """Return the nearest good direction (`cuelearner_jax.types.ValuesDirections`)."""
        values = self.values(obs, geometry.evenly_spaced(self.directions))
        return geometry.nearest_direction(values, spread, share, action)


def save(folder: Path, teacher: LearnedTeacher, about: dict[str, Any]) -> None:
    """Write a teacher's folder; `about` must hold the `layers` and `directions` of the network under `config`.

    Raises NotFinite, and writes nothing, for weights that half precision cannot hold.
    """
    params = jax.tree.map(lambda leaf: leaf.astype(jnp.float16), teacher.params)
    if not all_finite(params):
        advice = f"it was not written to {folder}; train with a smaller --teacher.learning-rate and another --out"
        raise NotFinite(f"the teacher's weights are not finite, or beyond {jnp.finfo(jnp.float16).max}: {advice}")
    folder.mkdir(parents=True, exist_ok=True)
    if (folder / "network").exists():  # delete an earlier teacher's file, which would be kept
        shutil.rmtree(folder / "network")
    with Checkpoints(folder / "network") as saved:
        saved.save(0, {"params": params})
    formats.write("teacher", folder / ABOUT, about)


def load(folder: Path, env: Any, aim_error: Any, habit: Any) -> LearnedTeacher:
    """Return a teacher that `save` wrote. Raises UserError if there is none, or its observations differ."""
    sizes = read_about(folder)["config"]
    layers = tuple(sizes["layers"])
    template = jax.eval_shape(lambda key: init_params(layers, env, key), jax.random.key(0))
    halves = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, jnp.float16), template)
    with Checkpoints(folder / "network", read_only=True) as saved:
        params = saved.restore({"params": halves})["params"]
    params = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), params)
    aim = jnp.asarray(aim_error, jnp.float32), jnp.asarray(habit, jnp.float32)
    return LearnedTeacher(env, params, *aim, layers, sizes["directions"])


def world_of(folder: Path, task: str, config: Any, apart: Collection[str]) -> Any:
    """Return the configuration of the world that a teacher learned in, who is asked in a task's configuration.

    `apart`: fields in which the two may differ, because they change nothing or the task handles them.
    """
    world = dict(read_about(folder)["task"])
    if (name := world.pop("name")) != task:
        raise UserError(f"the teacher in {folder} is one of {name}, not of {task}: give another folder")
    own = from_json(type(config), world)
    before, now = ({name: one for name, one in to_json(world).items() if name not in apart} for world in (own, config))
    for field, value in before.items():
        if value != now[field]:
            raise UserError(
                f"the teacher in {folder} learned with {_typed({field: value})} and does not know this world's "
                f"{_typed({field: now[field]})}: use the search teacher (--task.teacher search), or train one for this "
                f"world ({TRAIN} {task} {_typed(now)} --out FOLDER) and give --task.teacher FOLDER"
            )
    return own


def digest(folder: Path) -> str:
    """Return a short hash of a teacher's files. Raises UserError if there is no teacher."""
    read_about(folder)
    sha256 = hashlib.sha256()
    for file in [folder / ABOUT, *sorted((folder / "network").rglob("*"))]:
        if file.is_file():
            sha256.update(f"{file.relative_to(folder).as_posix()}\n".encode() + file.read_bytes())
    return sha256.hexdigest()[:12]


def read_about(folder: Path) -> dict[str, Any]:
    """Return the content of teacher.json. Raises UserError if it is missing or damaged."""
    if not (folder / ABOUT).is_file():
        advice = f"train one with `{TRAIN}` and give its folder (--task.teacher FOLDER)"
        raise UserError(f"no teacher in {folder}: {advice}, or use the search teacher (--task.teacher search)")
    return formats.read("teacher", folder / ABOUT)


def _typed(fields: dict[str, Any]) -> str:
    """Return fields of a task's configuration as command-line arguments."""
    values = {name: value if isinstance(value, list) else [value] for name, value in fields.items()}
    return " ".join(f"--task.{name.replace('_', '-')} {' '.join(map(str, value))}" for name, value in values.items())
