"""Check the laws of a task (`cuelearner_jax.task.Task`): its presets, scenarios, teacher and pictures."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import jax

from cuelearner_jax.environment import actions_of
from cuelearner_jax.evaluate import SPLITS
from cuelearner_jax.guides import registry
from cuelearner_jax.policies import uniform_in
from cuelearner_jax.run_config import check
from cuelearner_jax.runs import filming
from cuelearner_jax.runs.grid import Grid, check_grid
from cuelearner_jax.task import Task, shape_of
from cuelearner_jax.testing.environments import check_environment
from cuelearner_jax.testing.laws import Laws, shapes_of
from cuelearner_jax.types import ValuesDirections

FILMED = 3  # steps


def check_task(task: Task, small: Any = None, steps: int = 64, pictures: Path | None = None) -> None:
    """Check that a task keeps its laws. Raises AssertionError for the first law that is broken.

    `small` is a configuration that compiles quickly: its environment is checked for some steps, its teacher asked.
    Without one nothing is compiled. `pictures`: an empty folder for pictures of the small world (default: none).
    """
    laws = Laws(f"task {task.name}")
    for name, preset in task.presets.items():
        check(preset.config)
        task.check_evaluations(preset.config)
        check_grid(Grid(preset.guidance or ("none",), (preset.first_seed,), preset.labels))
        env = shape_of(task, preset.config.task)
        sizes = {other: shape_of(task, one.apply(preset.config.task)).obs_size for other, one in task.scenarios.items()}
        make = partial(task.environment, preset.config.task)
        splits = [jax.eval_shape(partial(make, split)) for split in ("training", *SPLITS)]
        possible = registry.possible(env, taught=task.teacher is not None)
        odd = [kind for kind in preset.guidance if registry.resolve(kind).name not in possible]
        laws.hold(not odd, f"preset {name!r} compares guidance {odd[:1]}, which it cannot have: of {list(possible)}")
        same = all(shapes_of(one) == shapes_of(splits[0]) for one in splits)  # they share one compiled program
        laws.hold(same, f"preset {name!r} has environments of other shapes for other splits: only values may differ")
        for other, size in sizes.items():
            broken = f"scenario {other!r} has observations of {size} entries, not {env.obs_size}"
            laws.hold(size == env.obs_size, f"{broken}: policies must act in it")
    if small is not None:
        laws.hold(isinstance(small, task.config), f"`small` is a {type(small).__name__}: give a {task.config.__name__}")
        env = task.environment(small)
        check_environment(env, steps)
        _check_teacher(laws, task, small, env)
        if pictures is not None:
            _check_pictures(laws, task, small, pictures)


def _check_teacher(laws: Laws, task: Task, config: Any, env: Any) -> None:
    state, obs = jax.jit(env.reset)(jax.random.key(0))
    action = actions_of(env).sample(jax.random.key(0), ())
    outcomes = sorted(jax.eval_shape(env.step, jax.random.key(0), state, action)[1].outcome)
    broken = f"its episodes have outcomes {outcomes}, but it does not say how long they last: fill `longest`"
    laws.hold(not outcomes or task.longest is not None, broken)
    if task.teacher is None:
        return

    @jax.jit
    def answers(env: Any) -> dict[str, jax.Array]:
        teacher = task.make_teacher(config, env)
        best = {"best action": teacher.best_action(state, obs)}
        if not isinstance(teacher, ValuesDirections):
            return best
        return {**best, "nearest good action": teacher.nearest_good(state, obs, best["best action"], 0.0, 1.0)}

    for name, one in answers(env).items():
        laws.hold(one.ndim == 1, f"its teacher's {name} has shape {one.shape}: give one action")
        laws.actions(actions_of(env), one, f"its teacher's {name}")


def _check_pictures(laws: Laws, task: Task, config: Any, folder: Path) -> None:
    pictures, env = task.pictures(), task.environment(config, "validation")
    film, still, question = files = filming.files(folder, task.name, "gif")
    rewards = filming.film(pictures, env, uniform_in(env), 0, FILMED, film, still)
    filming.question(pictures, env, uniform_in(env), 0, question)
    laws.hold(len(rewards) == FILMED, f"`record` returns {len(rewards)} rewards of {FILMED} steps: one a step")
    for file in files:
        laws.hold(file.is_file() and file.stat().st_size, f"{file.name} was not written: write the file that is named")
