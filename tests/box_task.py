"""A bandit with actions of a box, its task with a page, and scalars in shares of the box's ranges."""

import dataclasses

import jax
import jax.numpy as jnp
import page_task
import probes
from flax import struct

from cuelearner_jax.environment import Quantity, WholeObservations
from cuelearner_jax.spaces import Box, Cue
from cuelearner_jax.task import Body, Pictures, Preset, Task
from cuelearner_jax.types import Reel, Step

SMALL = Box((-1.0, 0.0, -2.0), (1.0, 4.0, 0.0))  # ranges 2, 4, 2
EPS = 0.1  # shares
SCALARS = dataclasses.replace(
    probes.SCALARS, eps_deg=EPS, tau_deg=0.01, tau_max_deg=1.0, scalar_within_deg=0.2, k_max=50
)


class Reach(WholeObservations, struct.PyTreeNode):
    """A bandit with actions of a box: rewarded within 0.1 of the ranges of a goal, which the observation tells.

    `offset` moves the goal along every entry, in shares: what a policy has learned elsewhere is then wrong.
    """

    actions: Box = struct.field(pytree_node=False, default=SMALL)
    offset: jax.Array | float = 0.0

    observation = (Quantity("context", 2, "1"),)
    action = Quantity("reach", 3, "1", "a vector of the box")

    def best(self, obs):
        """Return the best action: the middle of the box, and a fifth of its first two ranges along the observation."""
        shares = jnp.zeros(self.actions.size).at[:2].set(0.2 * obs) + self.offset
        return self.actions.exp(self.actions.spread(1)[0], shares)

    def reset(self, key):
        angle = jax.random.randint(key, (), 0, 4) * (jnp.pi / 2)
        obs = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        return obs, obs

    def step(self, key, state, action):
        reward = (self.actions.distance(self.best(state), action) <= 0.1).astype(jnp.float32)
        following, obs = self.reset(key)
        return following, Step(obs, state, state, reward, jnp.array(True), jnp.array(False), {"hit": reward}, {})


GRIPPER = Box(
    SMALL.low,
    SMALL.high,
    (
        Cue("sideways", ("left", "right"), ("ArrowLeft", "ArrowRight"), "shares"),
        Cue("height", ("up", "down"), ("r", "f"), "shares"),
        Cue("fingers", ("open", "close"), ("o", "c"), "shares"),
    ),
)


@dataclasses.dataclass(frozen=True)
class ArmConfig:
    """The bandit as a task's configuration."""

    offset: float = 0.0
    """Distance of the goal from its place in training [shares]."""


def _reel(env, state, action):
    """Film without motion; its words give the action's distance from the goal."""
    x, y = map(float, state)
    away = float(env.actions.distance(env.best(state), jnp.asarray(action)))
    return Reel(0.05, [{"dot": (x, -y, 0.0)}], f"{away:.2f}")


def _trails(env, state, actions):
    return [f"<path d='{index}'/>" for index in range(len(actions))]


PICTURES = Pictures(None, None, None, None, page_task.sketch, _reel, _trails)  # pyright: ignore[reportArgumentType]
TASK = Task(
    "box_arm",
    "a bandit with actions of a box",
    ArmConfig,
    (Body("arm", "", lambda config, split: Reach(GRIPPER, jnp.float32(config.offset)), pictures=lambda: PICTURES),),
    teacher=lambda config, env: probes.Expert(env),
    presets={
        "paper": Preset(
            "tiny",
            dataclasses.replace(probes.CONFIG, task=ArmConfig(), scalars=SCALARS),
            guidance=("relative",),
            labels=(20,),
        )
    },
)
