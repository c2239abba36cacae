"""Training as one request, filled alike by the command line and Python: kinds of guidance x seeds x label budgets.

Kinds are trained in turn; the lanes of a kind (seeds x label budgets) are trained side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from cuelearner_jax.adaptation.judging import step_of
from cuelearner_jax.devices import SHARED, lane_mesh, place, release_programs
from cuelearner_jax.environment import Environment
from cuelearner_jax.errors import NotFinite, UserError
from cuelearner_jax.feedback.answers import check_teacher
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.runs import failures
from cuelearner_jax.runs.grid import Grid, seeds_of
from cuelearner_jax.runs.lanes import LaneGroup
from cuelearner_jax.runs.order import Order, TrainRequest, in_folders, labels_of, make_plan, resolve_request
from cuelearner_jax.runs.runner import Runner
from cuelearner_jax.runs.training import Training, ambiguous_names, mean_of_finite
from cuelearner_jax.storage import formats, results
from cuelearner_jax.storage.folders import CONFIG, check_folder, claimed, prepare_folder
from cuelearner_jax.task import Preset, Task, shape_of
from cuelearner_jax.terminal import interruptible, progress_bars
from cuelearner_jax.types import Teacher


def preset_kinds(task: Task, preset: Preset) -> tuple[str, ...]:
    """Return the kinds of guidance that a preset compares: those it names, or all that the task supports."""
    return preset.guidance or guidances.possible(shape_of(task, preset.config.task), taught=task.teacher is not None)


def suggested(task: Task, preset: Preset) -> TrainRequest:
    """Return the request of a preset: its kinds of guidance, label budgets and seeds."""
    seeds = seeds_of(preset.first_seed, preset.seeds)
    return TrainRequest(task, preset.config, Grid(preset_kinds(task, preset), seeds, preset.labels))


def _begin(
    request: TrainRequest, env: Any, labels: Any, find: Callable[[Any], Teacher | None]
) -> tuple[list[LaneGroup], Teacher | None]:
    """Return the lane group of each kind, and who answers: None where no kind asks, or labels answer.

    `find`: environment -> teacher. Raises UserError for one that cannot be asked, or for ambiguous names of metrics.
    """
    if names := ambiguous_names(step_of(env)):
        raise UserError(f"a metric or outcome is called {names[0]!r}, as another column of results: give another name")
    config, env = request.config, place(lane_mesh(), env, SHARED)
    groups = [LaneGroup(config, env, config.guide_in(env, kind), request.grid) for kind in request.grid.guidance]
    asking = [group.guidance.name for group in groups if group.guidance.asks]
    if not asking or labels is not None:
        return groups, None
    if (teacher := find(env)) is None:
        raise UserError(f"guidance {asking[0]!r} asks a teacher: give one, for instance teacher_of(world)")
    check_teacher(teacher, config.scalars)
    return groups, place(lane_mesh(), teacher, SHARED)


def run(order: Order) -> None:
    """Train every lane of the grid (with a shard, of its seeds) and write the results to the order's folder.

    Raises UserError before anything is changed, Interrupted once everything is saved, and NotFinite at the end if some
    lanes stopped being finite.
    """
    release_programs()
    plan = make_plan(order)
    order, task, world = plan.order, plan.order.task, plan.order.config.task
    with progress_bars() as bars:
        waiting = bars.add_task("preparing", total=None, note="")
        groups, teacher = _begin(order, task.environment(world), plan.labels, lambda env: task.make_teacher(world, env))
        examined = task.environment(world, order.split)
        with claimed(order.out), interruptible() as stopping:
            # Nobody else can change it any more.
            check_folder(order.out, plan.described, order.resume, order.overwrite)
            prepare_folder(order.out, plan.described, order.overwrite and not order.resume)
            # Rows of what was begun earlier and of what comes now are of one configuration, as config.json tells it.
            described = formats.read("config", order.out / CONFIG)
            bars.remove_task(waiting)
            for number, group in enumerate(groups):
                ahead = sum(len(other.seeds) for other in groups[number + 1 :]) / len(group.seeds)
                Runner(group, examined, order, described, stopping, bars).run(teacher, plan.labels, ahead)
    if words := failures.summary(results.read([order.out / group.guidance.name for group in groups])):
        raise NotFinite(f"{words}: their rows in {order.out} are marked and left out of reports; all else is finished")


def run_each(orders: Sequence[Order]) -> None:
    """Run the orders of a grid of settings in turn, see `in_folders`; another float compiles nothing anew.

    Raises as `run`: UserError before anything is changed, and NotFinite after the last order.
    """
    orders, lost = in_folders(orders), []
    for order in orders:
        make_plan(order)
    for order in orders:
        try:
            run(order)
        except NotFinite as error:
            lost.append(str(error))
    if lost:
        raise NotFinite("; ".join(lost))


def in_memory(
    request: TrainRequest, env: Environment, examined: Environment, teacher: Teacher | None, progress: bool = True
) -> tuple[pa.Table, dict[str, Training]]:
    """Train every lane of the grid; write nothing. `env`, `examined`: environments for learning and for evaluations.

    Returns a row per lane and evaluation, as `api.training.Run` has them, and the trainings by kind of guidance.
    """
    release_programs()
    request = resolve_request(request)
    labels = labels_of(request)
    groups, teacher = _begin(request, env, labels, lambda env: teacher)
    rows, trainings = [], {}
    with progress_bars(visible=progress) as bars:
        for group in groups:
            name, training = group.guidance.name, Training(group, examined, request.split)
            training.blocks = group.start()
            if not training.labelled and labels is not None:
                training.take(labels)
            bar = bars.add_task(name, total=request.config.schedule.total_steps, note="")
            if not training.labelled and teacher is not None:
                label_bar = bars.add_task(f"{name}: labels", total=group.rounds, note="")
                for count in training.label_rounds(teacher):
                    bars.update(label_bar, completed=count)
            for row in training.stretches():
                rows.append(_table(group, row))
                bars.update(bar, completed=training.step, note=f"reward {mean_of_finite(row['reward'])}")
            trainings[name] = training
    return pa.concat_tables(rows, promote_options="permissive"), trainings


def _table(group: LaneGroup, row: dict[str, Any]) -> pa.Table:
    columns = {"guidance": group.guidance.name, **row}
    arrays = {name: np.broadcast_to(value, np.shape(value) or len(group.seeds)) for name, value in columns.items()}
    lists = {name: values if values.ndim == 1 else list(values) for name, values in arrays.items()}
    return pa.table({name: pa.array(values, from_pandas=True) for name, values in lists.items()})
