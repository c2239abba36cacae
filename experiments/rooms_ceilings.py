"""Estimate the best success in rooms from the robot's observation: clones of very many road-map actions.

    python experiments/rooms_ceilings.py --out FOLDER [--variants network ways] [--scale smoke]

A clone acts, the road map says at every step what it would have done, and the network goes on learning from all that
was said so far (DAgger: Ross, Gordon, Bagnell, 2011). What it reaches after 150,000 actions is about the most that this
observation allows a model of relative labels to reach. Two kinds of network: an MLP of the scan as it looks from the
goal's direction, and the weights of guidance `intent`, one network for all ways (`Navigation.aims`). All seeds of a
variant are one program. The road map itself is measured too. Success on validation episodes goes to
FOLDER/ceilings.json. On an H100 by estimate two minutes a variant.

The third ceiling, agents trained in rooms under guidance, is an ordinary sweep:

    cuelearner sweep navigation --preset paper --task.style rooms --sizes.frame action --guidance relative \
        --labels 500 --seeds 8 --out runs/rooms
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float

from cuelearner_envs.navigation.config import NavigationConfig
from cuelearner_jax.agents.networks import as_function, residual_network
from cuelearner_jax.environment import Aims, spaces_of
from cuelearner_jax.evaluate import episodes, evaluate_policy, rollout_lanes
from cuelearner_jax.guides.intent import Weights
from cuelearner_jax.policies import BY_LANE, SHARED, PolicyNode, Taught, best_actions
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.tasks import registry

FROM_HERE_DEG = 5.0  # a way is as likely as it lies near what the road map does: standard deviation [deg]


class Scale(NamedTuple):
    """How much of the study is run."""

    worlds: int
    walkers: int  # of each seed
    counts: tuple[int, ...]  # actions after which a clone is measured
    each: int  # actions between two stretches of learning
    steps: int  # of Adam in a stretch
    batch: int
    episodes: int
    seeds: int
    layers: tuple[int, ...]
    ways: tuple[int, ...]  # layers of the network that weighs ways


SCALES = {
    "smoke": Scale(2, 4, (80, 160), 80, 20, 16, 4, 2, (16,), (8,)),
    "quick": Scale(64, 64, (25_600, 51_200), 12_800, 1_000, 128, 100, 2, (256, 256), (64, 64)),
    "paper": Scale(
        1024, 256, (25_600, 51_200, 102_400, 153_600), 12_800, 3_000, 512, 2_000, 4, (512, 512, 512), (64, 64)
    ),
}
VARIANTS = ("network", "ways")


class Clone(PolicyNode):
    """A network that does what a road map did: a direction, or the most likely of the ways."""

    params: Any
    env: Any
    layers: tuple[int, ...] = struct.field(pytree_node=False)
    ways: bool = struct.field(pytree_node=False)

    def init(self, key: Array) -> Any:
        """Parameters of a network that knows nothing."""
        spaces = spaces_of(self.env)
        if self.ways:
            return Weights(self.layers).init(key, jnp.zeros((1, spaces.aims or 0)), jnp.ones(1, bool))
        assert spaces.features is not None
        return residual_network(self.layers, 2).init(key, *(jnp.zeros(width) for width in spaces.features))

    def weighed(self, params: Any, obs: Float[Array, "n obs"]) -> tuple[Aims, Array]:
        """The ways of situations, and how likely each is (n, ways), as logarithms."""
        aims = jax.vmap(self.env.aims)(obs)
        rows = jax.vmap(Weights(self.layers).apply, (None, 0, 0))(params, aims.features, aims.possible)
        return aims, jax.nn.log_softmax(jnp.maximum(jnp.asarray(rows)[:, :-1], -30.0))

    def towards(self, params: Any, obs: Float[Array, "n obs"]) -> Float[Array, "n 2"]:
        """The network's output as a vector in the body's frame; it is one in the frame of the goal's direction."""
        goals = jax.vmap(self.env.heuristic)(obs)
        seen = jax.vmap(self.env.features)(obs, goals)
        return DIRECTIONS.outward(as_function(residual_network(self.layers, 2))(params, *seen), goals)

    def loss(self, params: Any, obs: Float[Array, "n obs"], best: Float[Array, "n 2"]) -> Float[Array, ""]:
        """Return the clone's distance from the road map's actions."""
        if not self.ways:
            return jnp.mean(jnp.sum(jnp.square(self.towards(params, obs) - best), -1))
        aims, likely = self.weighed(params, obs)
        away = DIRECTIONS.distance(aims.actions, best[:, None])
        wanted = jax.nn.softmax(-jnp.square(away / jnp.deg2rad(FROM_HERE_DEG)) / 2)
        return -jnp.mean(jnp.sum(wanted * likely, -1))

    def act(self, key: Array, states: Any, obs: Float[Array, "n obs"]) -> Float[Array, "n 2"]:
        """Return the clone's actions."""
        if not self.ways:
            return DIRECTIONS.retract(self.towards(self.params, obs))
        aims, likely = self.weighed(self.params, obs)
        assert aims.open is not None
        best = jnp.where(aims.open, likely, -jnp.inf).argmax(-1)
        return jnp.take_along_axis(aims.actions, best[:, None, None], axis=1)[:, 0]

    @property
    def axes(self) -> Any:
        """Each seed has its own network."""
        return self.replace(params=BY_LANE, env=SHARED)


class Cloning(struct.PyTreeNode):
    """A seed on its way."""

    params: Any
    moments: Any  # Adam's
    states: Any  # of the walkers
    obs: Array  # (walkers, obs)
    seen: Array  # (actions, obs) so far, and room for the rest
    shown: Array  # (actions, 2)


def begin(clone: Clone, scale: Scale, adam: Any, seed: Array) -> Cloning:
    """Walkers at the start of an episode, and a network that knows nothing."""
    k_net, k_env = jax.random.split(jax.random.key(seed))
    params = clone.init(k_net)
    states, obs = jax.vmap(clone.env.reset)(jax.random.split(k_env, scale.walkers))
    room = scale.counts[-1]
    return Cloning(params, adam.init(params), states, obs, jnp.zeros((room, obs.shape[-1])), jnp.zeros((room, 2)))


def stretch(clone: Clone, scale: Scale, adam: Any, teacher: Any, seed: Array, done: Array, cloning: Cloning) -> Cloning:
    """Walk for `scale.each` actions, which the road map comments on, and learns from all of them so far.

    Until the first stretch of learning the road map walks itself.
    """
    keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), 1 + done), 2)
    acting = clone.replace(params=cloning.params)

    def step(carry: tuple[Any, Array], key: Array) -> tuple[tuple[Any, Array], tuple[Array, Array]]:
        states, obs = carry
        best = best_actions(teacher, states, obs)
        action = jnp.where(done > 0, acting.act(key, states, obs), best)
        after, found = jax.vmap(clone.env.step)(jax.random.split(key, scale.walkers), states, action)
        return (after, found.obs), (obs, best)

    (states, obs), (seen, shown) = jax.lax.scan(
        step, (cloning.states, cloning.obs), jax.random.split(keys[0], scale.each // scale.walkers)
    )
    put = partial(jax.lax.dynamic_update_slice_in_dim, start_index=done, axis=0)
    seen = put(cloning.seen, seen.reshape(-1, seen.shape[-1]))
    shown = put(cloning.shown, shown.reshape(-1, 2))

    def learn(carry: tuple[Any, Any], key: Array) -> tuple[tuple[Any, Any], None]:
        params, moments = carry
        rows = jax.random.randint(key, (scale.batch,), 0, done + scale.each)
        updates, moments = adam.update(jax.grad(clone.loss)(params, seen[rows], shown[rows]), moments, params)
        return (optax.apply_updates(params, updates), moments), None

    start = (cloning.params, cloning.moments)
    (params, moments), _ = jax.lax.scan(learn, start, jax.random.split(keys[1], scale.steps))
    return Cloning(params, moments, states, obs, seen, shown)


def cloned(variant: str, scale: Scale) -> list[dict[str, Any]]:
    """A variant's rows: all seeds after every number of actions."""
    task = registry.find("navigation")
    world = NavigationConfig(style="rooms", worlds=scale.worlds)
    env, shown = task.environment(world, "training"), task.environment(world, "validation")
    teacher, ways = task.make_teacher(world, env), variant == "ways"
    clone = Clone({}, env, scale.ways if ways else scale.layers, ways)
    rate = optax.cosine_decay_schedule(1e-3, scale.counts[-1] // scale.each * scale.steps, 0.1)
    adam = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))
    seeds = jnp.arange(scale.seeds)
    block = jax.jit(jax.vmap(partial(begin, clone, scale, adam)))(seeds)

    @partial(jax.jit, donate_argnums=3)
    def go_on(env: Any, teacher: Any, done: Array, block: Cloning) -> Cloning:
        there = clone.replace(env=env)
        return jax.vmap(partial(stretch, there, scale, adam, teacher), (0, None, 0))(seeds, done, block)

    rows, steps = [], scale.episodes * world.max_steps
    for done in range(0, scale.counts[-1], scale.each):
        block = go_on(env, teacher, jnp.asarray(done), block)
        if (count := done + scale.each) in scale.counts:
            policy = clone.replace(params=block.params, env=shown)
            found = rollout_lanes(shown, policy, episodes(), scale.episodes, steps).means
            rows += [_row(variant, count, seed, found, seed) for seed in range(scale.seeds)]
            print(f"{variant}: {count} actions, success {found['success'].mean():.3f}", flush=True)
    return rows


def _row(variant: str, count: int, seed: int, found: Any, index: Any) -> dict[str, Any]:
    metrics = {name: float(np.asarray(found[name])[index]) for name in ("success", "collision", "timeout", "reward")}
    return {"variant": variant, "actions": count, "seed": seed, **metrics}


def of_road_map(scale: Scale) -> list[dict[str, Any]]:
    """The road map itself on the same episodes."""
    task, world = registry.find("navigation"), NavigationConfig(style="rooms", worlds=scale.worlds)
    env = task.environment(world, "validation")
    policy = Taught(task.make_teacher(world, env))
    found = evaluate_policy(env, policy, episodes(), scale.episodes, scale.episodes * world.max_steps)
    return [_row("road map", 0, 0, found, ())]


def table(rows: Sequence[dict[str, Any]], count: int) -> str:
    """Means over seeds with 95% intervals: over seeds' means (normal), or over episodes where there is one seed."""
    lines = [f"{'variant':<16} {'actions':>8} {'success':>8}  95% interval     collisions  time-outs"]
    for variant, actions in dict.fromkeys((row["variant"], row["actions"]) for row in rows):
        own = [row for row in rows if (row["variant"], row["actions"]) == (variant, actions)]
        success = np.array([row["success"] for row in own])
        mean = success.mean()
        error = np.sqrt(mean * (1 - mean) / (count * len(own)))
        if len(own) > 1:
            error = max(error, success.std(ddof=1) / np.sqrt(len(own)))
        other = [np.mean([row[name] for row in own]) for name in ("collision", "timeout")]
        low, high = max(mean - 1.96 * error, 0), min(mean + 1.96 * error, 1)
        lines.append(
            f"{variant:<16} {actions:>8} {mean:8.3f}  [{low:.3f}, {high:.3f}]   {other[0]:10.3f} {other[1]:10.3f}"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the variants; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scale", choices=list(SCALES), default="paper", help="smoke: a minute on a CPU")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    parser.add_argument("--out", type=Path, default=Path("runs/rooms_ceilings"), help="folder")
    asked = parser.parse_args(arguments)
    scale, file = SCALES[asked.scale], asked.out / "ceilings.json"
    rows = json.loads(file.read_text()) if file.exists() else []
    asked.out.mkdir(parents=True, exist_ok=True)
    for variant in ("road map", *asked.variants):
        if not any(row["variant"] == variant for row in rows):  # what is there already stays
            rows += of_road_map(scale) if variant == "road map" else cloned(variant, scale)
            file.write_text(json.dumps(rows, indent=1))
    print(table(rows, scale.episodes))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
