"""Ways that a policy walks in one corridor, kept as numbers, and their picture."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from cuelearner_envs.navigation.drawing import draw_world
from cuelearner_envs.navigation.world import World
from cuelearner_jax.evaluate import episodes
from cuelearner_jax.report.figures import save_figure

FILE = "trajectories.json"
WAYS = 12


def walked(env: Any, policy: Any, split: str, steps: int) -> list[list[list[float]]]:
    """The ways (x, y) [m] of the first episodes of `WAYS` environments in the first world of an environment."""
    alone = env.replace(worlds=jax.tree.map(lambda leaf: leaf[:1], env.worlds))

    @jax.jit
    def play(env: Any, policy: Any, key: Any) -> tuple[Any, Any]:
        k_reset, k_run = jax.random.split(key)
        state, obs = jax.vmap(env.reset)(jax.random.split(k_reset, WAYS))

        def step(carry: tuple, index: jax.Array) -> tuple[tuple, Any]:
            state, obs, first = carry
            key = jax.random.fold_in(k_run, index)
            after, made = jax.vmap(env.step)(jax.random.split(key, WAYS), state, policy.act(key, state, obs))
            return (after, made.obs, first & ~(made.terminated | made.truncated)), (state.pose[:, :2], first)

        return jax.lax.scan(step, (state, obs, jnp.ones(WAYS, bool)), jnp.arange(steps))[1]

    places, first = jax.device_get(play(alone, policy, episodes(split)))
    return [np.round(places[first[:, way], way], 3).tolist() for way in range(WAYS)]


def write(folder: Path, env: Any, policies: Mapping[str, Any], split: str, steps: int) -> None:
    """Keep the ways of policies by name, and the world that they are in."""
    world = jax.tree.map(lambda leaf: np.asarray(leaf[0]).tolist(), env.worlds)
    ways = {name: walked(env, policy, split, steps) for name, policy in policies.items()}
    told = {"world": {name: getattr(world, name) for name in World.__dataclass_fields__}, "ways": ways}
    (folder / FILE).write_text(json.dumps(told) + "\n")


def draw(files: Mapping[str, Path], stem: Path) -> None:
    """A picture of kept ways: before, then after, one below the other, for each file by its title."""
    panels = []
    for number, (title, file) in enumerate(files.items()):
        told = json.loads(file.read_text())
        world = World(**{name: jnp.array(values) for name, values in told["world"].items()})
        before, after = told["ways"].values()
        panels += [("before", world, before)] if number == 0 else []
        panels.append((title, world, after))
    figure = Figure(figsize=(7, 2.0 * len(panels)), layout="constrained")
    for axes, (title, world, ways) in zip(figure.subplots(len(panels), 1, squeeze=False)[:, 0], panels, strict=True):
        draw_world(axes, world)
        axes.set_title(title, fontsize=9, loc="left")
        for way in ways:
            x, y = np.array(way).T
            axes.plot(x, y, color="#0072B2" if x[-1] > x[0] else "#D55E00", linewidth=1.2, zorder=3)
            axes.plot(x[:1], y[:1], "o", color="#595959", markersize=3, zorder=4)
    save_figure(figure, stem)
