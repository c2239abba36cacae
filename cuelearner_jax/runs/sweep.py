"""A grid of runs in one process: kinds of guidance in turn, their lanes (seeds x label budgets) vmapped, resumable."""

from __future__ import annotations

from cuelearner_jax.devices import SHARED, lane_mesh, place
from cuelearner_jax.feedback.answers import check_teacher
from cuelearner_jax.runs import failures
from cuelearner_jax.runs.grid import defaults
from cuelearner_jax.runs.lane_checkpoints import check_standing
from cuelearner_jax.runs.lanes import LaneGroup
from cuelearner_jax.runs.memory_report import memory_report
from cuelearner_jax.runs.order import Order, planned
from cuelearner_jax.runs.runner import Runner
from cuelearner_jax.storage import formats
from cuelearner_jax.storage.folders import CONFIG, check_folder, claimed, prepare_folder
from cuelearner_jax.task import shape_of
from cuelearner_jax.terminal import console, interruptible, progress_bars


def run(order: Order) -> None:
    """Trains every lane of the grid and leaves the results in the order's folder.

    With a shard, trains its share of the seeds alone, from wherever that stands.

    Raises:
        UserError: bad configuration, a folder in use, too little memory; nothing has been changed then.
        Interrupted: Ctrl-C or SIGTERM; everything is saved.
        NotFinite: all is done, but some lanes stopped being finite.
    """
    plan = planned(order)
    order = plan.order
    task, config = order.task, order.config
    mesh, shape = lane_mesh(), shape_of(task, config.task)
    for kind in order.grid.guidance:  # before anything is made that has a size
        made = config.guide_in(shape, kind)
        console.print(memory_report(LaneGroup(config, shape, made, order.grid)))
    env = place(mesh, task.environment(config.task), SHARED)
    kinds = [config.guide_in(env, kind) for kind in order.grid.guidance]
    groups = [LaneGroup(config, env, kind, order.grid) for kind in kinds]
    asked = any(kind.asks for kind in kinds) and plan.labels is None
    teacher = place(mesh, task.make_teacher(config.task, env), SHARED) if asked else None
    if asked:
        check_teacher(teacher, config.scalars)
    examined = task.environment(config.task, order.split)
    with claimed(order.out), interruptible() as stopping, progress_bars() as bars:
        # Nobody else can change it any more.
        check_folder(order.out, plan.described, order.resume, order.overwrite, defaults(task))
        for group in groups if order.resume else ():
            check_standing(group, order.out / group.guidance.name, given=plan.labels is not None)
        prepare_folder(order.out, plan.described, order.overwrite and not order.resume)
        # Rows of what was begun earlier and of what comes now are of one configuration, as config.json tells it.
        described = formats.read("config", order.out / CONFIG)
        for group in groups:
            Runner(group, examined, order, described, stopping, bars).run(teacher, plan.labels)
    failures.check(order.out, [order.out / group.guidance.name for group in groups])
