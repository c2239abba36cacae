"""A space of one's own in one file: a wrist that turns and a gripper that opens, on the lids of jars.

An angle has no ends and an opening has two, so that neither directions nor a box will do. `log` and `exp` are the whole
geometry: answers, refinement, bounds, label files, the labelling page and exported decisions follow from them. Run in
the folder above this one:

    cuelearner train examples.wrist:TASK --preset quickstart --out runs/wrist
    cuelearner evaluate runs/wrist --task examples.wrist:TASK --policy guide
    cuelearner adapt runs/wrist --task examples.wrist:TASK --scenario loose_mount --out policies/wrist
    cuelearner export runs/wrist --task examples.wrist:TASK --format numpy --out exported/wrist
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.agents import ddqn
from cuelearner_jax.config import Scalars, Schedule, Sizes
from cuelearner_jax.environment import Quantity, WholeObservations
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.spaces import Box, Cue, Space
from cuelearner_jax.spaces.directions import difference, from_angle, retract, rotate
from cuelearner_jax.task import Body, Preset, Scenario, Task
from cuelearner_jax.types import Step

X_AXIS = (1.0, 0.0)
UNROLLED = Box((-1.0, 0.0), (1.0, 1.0))  # the turn from x in half turns, and the opening
CLOSE_ENOUGH = 0.1  # to turn a lid, along either cue [shares]


@dataclass(frozen=True)
class Wrist(Space):
    """(cos, sin, opening): where the wrist points, and how far the gripper is open, from 0 to 1.

    Both cues count in shares: of half a turn, and of the whole opening.
    """

    name = "wrist"
    about = "unit vectors with an opening from 0 to 1"
    size = 3
    cues = (
        Cue("wrist", ("counterclockwise", "clockwise"), ("ArrowLeft", "ArrowRight"), "shares"),
        Cue("gripper", ("open", "close"), ("o", "c"), "shares"),
    )
    reach = 1.0

    def log(self, action: Array, other: Array) -> Float[Array, "... 2"]:
        """Return the turn, wrapped, and the change of the opening."""
        turn = difference(action[..., :2], other[..., :2]) / jnp.pi
        return jnp.stack([turn, jnp.asarray(other)[..., 2] - jnp.asarray(action)[..., 2]], -1)

    def exp(self, action: Array, change: Array) -> Float[Array, "... 3"]:
        """Turn the wrist and move the fingers, no farther than they go."""
        change = jnp.asarray(change)
        turned = rotate(action[..., :2], jnp.pi * change[..., 0])
        opening = jnp.clip(action[..., 2] + change[..., 1], 0.0, 1.0)
        return jnp.concatenate([turned, opening[..., None]], -1)

    def retract(self, vector: Array) -> Float[Array, "... 3"]:
        """Return the nearest direction and the nearest opening; NaN for a vector that is not finite."""
        near = jnp.concatenate([retract(vector[..., :2]), jnp.clip(vector[..., 2:], 0.0, 1.0)], -1)
        return jnp.where(jnp.isfinite(vector).all(-1, keepdims=True), near, jnp.nan)

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Float[Array, "*shape 3"]:
        """Draw both uniformly."""
        return self._rolled(UNROLLED.sample(key, shape))

    def spread(self, count: int) -> Float[Array, "count 3"]:
        """Return pairs of a turn and an opening, spread evenly."""
        return self._rolled(UNROLLED.spread(count))

    def _rolled(self, unrolled: Float[Array, "... 2"]) -> Float[Array, "... 3"]:
        return jnp.concatenate([from_angle(jnp.pi * unrolled[..., 0]), unrolled[..., 1:]], -1)


WRIST = Wrist()


@dataclass(frozen=True)
class LidConfig:
    """The jars, and how the gripper is mounted."""

    mount: float = 0.0
    """Changed world: the gripper is mounted rotated counterclockwise by this angle [half turns]."""


class Lids(WholeObservations, struct.PyTreeNode):
    """One lid an episode, seen as the way its rib points and its width: it turns if both are met."""

    mount: Float[Array, ""] | float = 0.0

    actions = WRIST
    action = Quantity("grasp", 3, "1", "cos and sin of the wrist, opening of the gripper from 0 to 1")
    observation = (Quantity("rib", 2, "1", "the way it points"), Quantity("width", 1, "1", "of the widest lid"))

    def best(self, obs: Float[Array, "3"]) -> Float[Array, "3"]:
        """The wrist along the rib, the gripper a little wider than the lid."""
        return WRIST.exp(obs, jnp.array([-self.mount, 0.1]))

    def reset(self, key: PRNGKeyArray) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """A lid of some width, turned any way."""
        k_way, k_width = jax.random.split(key)
        way = from_angle(jax.random.uniform(k_way, (), maxval=2 * jnp.pi))
        obs = jnp.append(way, jax.random.uniform(k_width, (), minval=0.2, maxval=0.8))
        return obs, obs

    def step(self, key: PRNGKeyArray, state: Array, action: Float[Array, "3"]) -> tuple[Array, Step]:
        """Grasp; the next lid follows."""
        turned = (WRIST.distance(action, self.best(state)) <= CLOSE_ENOUGH).astype(jnp.float32)
        following, obs = self.reset(key)
        return following, Step(obs, state, state, turned, jnp.array(True), jnp.array(False), {"turned": turned}, {})


class Cook(struct.PyTreeNode):
    """A teacher who knows how a lid is grasped."""

    env: Lids

    def best_action(self, state: Array, obs: Float[Array, "3"]) -> Float[Array, "3"]:
        """The best grasp."""
        return self.env.best(obs)


TASK = Task(
    name="lids",
    about="turn the lids of jars: a wrist and a gripper",
    config=LidConfig,
    bodies=(Body("gripper", "turns and opens", lambda config, split: Lids(jnp.float32(config.mount))),),
    teacher=lambda config, env: Cook(env),
    scenarios={"loose_mount": Scenario("the gripper is mounted a fifth of half a turn askew", {"mount": 0.2})},
    presets={
        "quickstart": Preset(
            "guided by 300 labels: seconds on two CPU cores",
            RunConfig(
                LidConfig(),
                Sizes(feedback_layers=(64, 64), num_envs=10, labels_per_round=50, fit_steps=600, fit_batch_size=64),
                Scalars(feedback_learning_rate=0.005, eps_deg=0.1, tau_deg=0.01, tau_max_deg=1.0, max_grad_norm=10.0),
                Schedule(
                    total_steps=2_000,
                    random_steps=100,
                    learn_after=100,
                    guidance_until=1_500,
                    eval_every=1_000,
                    eval_steps=2_000,
                    eval_envs=200,
                    checkpoint_every=2_000,
                ),
                ddqn.DdqnConfig(
                    q_layers=(64, 64),
                    directions=400,
                    target_directions=16,
                    batch_size=64,
                    replay_capacity=20_000,
                    optimizer="adam",
                    learning_rate=0.003,
                ),
            ),
            guidance=("relative",),
            labels=(300,),
        )
    },
)
