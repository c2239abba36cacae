"""Check the laws of a task (`cuelearner_jax.task.Task`): its presets, scenarios, teacher and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax

from cuelearner_jax.environment import actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import SPLITS
from cuelearner_jax.guides import registry
from cuelearner_jax.policies import uniform_in
from cuelearner_jax.run_config import check
from cuelearner_jax.runs import filming
from cuelearner_jax.runs.grid import Grid, check_grid
from cuelearner_jax.task import Task, shape_of
from cuelearner_jax.testing.environments import check_environment
from cuelearner_jax.testing.laws import Laws, same_shapes
from cuelearner_jax.types import ValuesDirections

FILMED = 3  # steps


def check_task(
    task: Task, small: Any = None, steps: int = 64, pictures: Path | None = None, tolerance: float = 1e-5
) -> None:
    """Check that a task keeps its laws. Without a small world nothing is compiled.

    Raises AssertionError for the first law that is broken.

    Args:
        task: the task.
        small: a configuration of it that compiles quickly: its environment is checked, its teacher asked.
        steps: steps of that environment's roll-out.
        pictures: an empty folder, for pictures of the small world (default: none are drawn).
        tolerance: as for `check_environment`.
    """
    laws = Laws(f"task {task.name}", tolerance)
    laws.hold(task.about, "it says nothing of itself: fill `about`, for help pages")
    for name, preset in task.presets.items():
        with laws.attempted(f"preset {name!r}", "its values must pass cuelearner_jax.config.check"):
            check(preset.config)
            task.check_evaluations(preset.config)
            check_grid(Grid(preset.guidance or ("none",), (preset.first_seed,), preset.labels))
        with laws.attempted(f"the environment of preset {name!r}", "it must follow from the configuration alone"):
            env = shape_of(task, preset.config.task)
            worlds = {other: shape_of(task, one.apply(preset.config.task)) for other, one in task.scenarios.items()}
        possible = registry.possible(env, taught=task.teacher is not None)
        odd = [kind for kind in preset.guidance if registry.resolve(kind).name not in possible]
        laws.hold(not odd, f"preset {name!r} compares guidance {odd[:1]}, which it cannot have: of {list(possible)}")
        with laws.attempted(f"the splits of preset {name!r}", f"make an environment of training and of {[*SPLITS]}"):
            first, *others = (_of_split(task, preset.config.task, split) for split in ("training", *SPLITS))
        same = all(same_shapes(one, first) for one in others)
        laws.hold(same, f"preset {name!r} has environments of other shapes for other splits: only values may differ")
        for other, world in worlds.items():
            size = world.obs_size
            told = f"scenario {other!r} has observations of {size} entries, not {env.obs_size}: policies must act in it"
            laws.hold(size == env.obs_size, told)
    if small is not None:
        laws.hold(isinstance(small, task.config), f"`small` is a {type(small).__name__}: give a {task.config.__name__}")
        _check_longest(laws, task, small)
        check_environment(task.environment(small), steps, tolerance=tolerance)
        _check_teacher(laws, task, small)
    if pictures is not None:
        laws.hold(small is not None, "pictures are of the small world: give `small`")
        _check_pictures(laws, task, small, pictures)


def _of_split(task: Task, config: Any, split: str) -> Any:
    """Return the shapes of an environment; all splits must share one compiled program."""
    return jax.eval_shape(lambda: task.environment(config, split))


def _check_longest(laws: Laws, task: Task, config: Any) -> None:
    """Check that the longest episode is known where episodes have outcomes."""
    env = task.environment(config)
    state, _ = jax.eval_shape(env.reset, jax.random.key(0))
    action = jax.eval_shape(lambda: actions_of(env).sample(jax.random.key(0), ()))
    outcomes = sorted(jax.eval_shape(env.step, jax.random.key(0), state, action)[1].outcome)
    laws.hold(
        not outcomes or task.longest is not None,
        f"its episodes have outcomes {outcomes}, but it does not say how long they last: fill `longest`",
    )


def _check_teacher(laws: Laws, task: Task, config: Any) -> None:
    if task.teacher is None:
        return
    env = task.environment(config)

    @jax.jit
    def asked(env: Any, key: jax.Array) -> dict[str, jax.Array]:
        teacher, (state, obs) = task.make_teacher(config, env), env.reset(key)
        best = teacher.best_action(state, obs)
        if not isinstance(teacher, ValuesDirections):
            return {"best action": best}
        return {"best action": best, "nearest good action": teacher.nearest_good(state, obs, best, 0.0, 1.0)}

    with laws.attempted("its teacher's best_action", "it gets one state and its observation, in jax.numpy"):
        answers = asked(env, jax.random.key(0))
    for name, action in answers.items():
        laws.hold(action.ndim == 1, f"its teacher's {name} has shape {action.shape}: give one action")
        laws.actions(actions_of(env), action, f"its teacher's {name}")


def _check_pictures(laws: Laws, task: Task, config: Any, folder: Path) -> None:
    """Check a film, a still and a question of a few random steps."""
    try:
        drawn = task.pictures()
    except UserError as error:
        raise AssertionError(f"{laws.subject}: {error}") from error
    env = task.environment(config, "validation")
    policy, files = uniform_in(env), filming.files(folder, task.name, "gif")
    with laws.attempted("drawing", "see cuelearner_jax.task.Pictures for what each of its functions gets"):
        rewards = filming.film(drawn, env, policy, 0, FILMED, files)
        filming.question(drawn, env, policy, 0, files.question)
    laws.hold(len(rewards) == FILMED, f"`record` returns {len(rewards)} rewards of {FILMED} steps: one a step")
    for file in files:
        laws.hold(file.is_file() and file.stat().st_size, f"{file.name} was not written: write the file that is named")
