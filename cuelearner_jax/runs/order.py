"""Training requests and their validation; nothing here writes to disk."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from cuelearner_jax import config as configuration
from cuelearner_jax import run_config
from cuelearner_jax.asking import label_slots
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.environment import actions_of, spaces_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback import external_labels
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs.grid import Grid, check_grid, describe, with_control
from cuelearner_jax.runs.shards import OWN, Shard, differing_options
from cuelearner_jax.storage import formats, label_files, tracking
from cuelearner_jax.storage.folders import CONFIG, check_folder
from cuelearner_jax.storage.results import SETTINGS, setting_name
from cuelearner_jax.task import Task, shape_of

RequestT = TypeVar("RequestT", bound="TrainRequest")


@dataclass(frozen=True)
class TrainRequest:
    """A request to train a grid of runs of one task."""

    task: Task
    config: RunConfig
    grid: Grid
    labels_from: Path | None = field(default=None, kw_only=True)  # a label file in place of the teacher
    split: str = field(default="validation", kw_only=True)  # split of the evaluation episodes


@dataclass(frozen=True)
class Order(TrainRequest):
    """A request to train into a folder."""

    out: Path
    resume: bool = False
    overwrite: bool = False
    shard: Shard | None = None  # train only this share of the seeds, in a folder of its own below `out`
    track: str | None = None  # tracker to write to, see `storage.tracking`
    setting: tuple[tuple[str, float], ...] = ()  # in a grid of settings: the options that differ, as part.field


class Plan(NamedTuple):
    """A validated order; nothing has been written."""

    order: Order  # of this shard: its seeds and its folder
    described: dict[str, Any]  # the contents of config.json
    labels: label_files.LabelFile | None


def resolve_request(request: RequestT) -> RequestT:
    """Check a request; return it with its kinds of guidance by name, once code from outside is loaded."""
    run_config.check(request.config)
    names = tuple(guidances.resolve(kind).name for kind in request.grid.guidance)
    request = replace(request, grid=with_control(replace(request.grid, guidance=names)))
    check_grid(request.grid)
    request.task.check_evaluations(request.config)
    space, eps = actions_of(shape_of(request.task, request.config.task)), request.config.scalars.eps_deg
    asks = [kind for kind in request.grid.guidance if guidances.find(kind).needs_cues]
    if asks and not space.grain <= eps <= space.reach:
        why = f"every answer of {asks[0]} would be the same"
        raise UserError(f"scalars.eps_deg is {eps:g} {space.unit}, and {why}: give {space.grain:g} to {space.reach:g}")
    return request


def labels_of(request: TrainRequest) -> label_files.LabelFile | None:
    """Return the labels used in place of the teacher; None: ask the teacher. Raises UserError if they do not fit."""
    if request.labels_from is None:
        return None
    config = request.config
    if config.sizes.store_labelled:
        raise UserError("sizes.store_labelled keeps steps, but a label file has none: leave out one of the two")
    return read_labels(request.labels_from, request.task, config.task, config.sizes, config.scalars, request.grid)


def in_folders(orders: Sequence[Order]) -> list[Order]:
    """Return the orders of a grid of settings, each in a folder of its own below `out`; a single order stays there.

    Where some have begun, `resume` resumes these and begins the others.
    """
    if not orders[0].setting:
        return list(orders)
    if (out := orders[0].out / CONFIG).exists():
        raise UserError(f"{out.parent} holds a run of one setting: give another --out")
    folders = [order.out / setting_name(dict(order.setting)) for order in orders]
    if orders[0].overwrite and (others := sorted({*orders[0].out.glob(SETTINGS)} - {*folders})):
        raise UserError(f"{others[0]} is of another grid, and --overwrite keeps it: delete it, or give another --out")
    begun = [(folder / CONFIG).is_file() for folder in folders]
    none = not any(begun) and orders[0].shard is None  # then each order says so; a shard resumes by itself
    each = zip(orders, folders, begun, strict=True)
    return [replace(order, out=folder, resume=order.resume and (none or old)) for order, folder, old in each]


def make_plan(order: Order) -> Plan:
    """Check what `run` would refuse, except for memory; return the plan. Raises UserError."""
    tracking.check(order.track)
    order, sweep = resolve_request(order), order
    if shard := order.shard:
        folder = shard.folder(order.out)
        begun = not order.overwrite and (folder / CONFIG).is_file()
        grid = replace(order.grid, seeds=shard.seeds(order.grid.seeds))
        order = replace(order, grid=grid, out=folder, resume=order.resume or begun)
    env = shape_of(order.task, order.config.task)
    for kind in order.grid.guidance:
        order.config.guide_in(env, kind)
    labels = labels_of(order)
    contents = describe(order.task, order.config, order.grid, order.split, order.labels_from)
    contents |= {"setting": dict(order.setting)} if order.setting else {}
    if shard:
        contents["shard"] = {**shard._asdict(), "seeds": list(sweep.grid.seeds)}
        shard.check_sweep(sweep.out, contents)
    check_folder(order.out, contents, order.resume, order.overwrite)
    if order.setting and not order.overwrite:
        _check_settings(sweep.out.parent, contents)
    return Plan(order, contents, labels)


def _check_settings(out: Path, contents: dict[str, Any]) -> None:
    """Raise UserError unless a setting, described by `contents`, belongs to the grid whose settings have begun."""
    pattern, own = ("shard-*-of-*/", OWN) if "shard" in contents else ("", ())
    now = {**contents, "setting": sorted(contents["setting"])}
    for path in sorted(out.glob(f"{SETTINGS}/{pattern}{CONFIG}")):
        before = formats.read("config", path)
        before["setting"] = sorted(before.get("setting", ()))
        if names := differing_options(before, now, (*own, *now["setting"])).replace("grid.", ""):
            raise UserError(f"{path.parent} is of a grid with another {names}: give the same options, or another --out")


def read_labels(
    path: Path, task: Task, world: Any, sizes: GuideSizes, scalars: Scalars, grid: Grid
) -> label_files.LabelFile:
    """Read a label file for a task's world (a configuration) and a grid. Raises UserError if it does not fit."""
    file, env = label_files.read(path), shape_of(task, world)
    _check_world(path, file.task, task, world)
    if not (asking := [kind for kind in map(guidances.find, grid.guidance) if kind.form is not None]):
        fitting = [kind.name for kind in guidances.guides().values() if kind.form and kind.form.name == file.answers]
        raise UserError(f"--labels-from needs a guidance that uses labels: add --guidance {' or '.join(fitting)}")
    for kind in asking:
        form: Any = kind.form
        if form.name != file.answers:
            needs = f"guidance {kind.name} needs {form.name} answers"
            raise UserError(f"{path} holds {file.answers} answers, but {needs}: give fitting labels")
        external_labels.check_file(file, spaces_of(env), form, str(path))
    if file.eps is not None and not math.isclose(file.eps, scalars.eps_deg, rel_tol=1e-6):
        why = f"{path} holds labels of {file.eps:g} {file.space.unit}, the run expects {scalars.eps_deg:g}"
        raise UserError(f"{why}: give --scalars.eps-deg {file.eps:g}, or other labels")
    for kind in asking:
        seeds, budgets = grid.lanes(kind)
        label_files.for_lanes(file, seeds, budgets, label_slots(int(budgets.max()), sizes))
    return file


def _check_world(path: Path, head: dict[str, Any], task: Task, world: Any) -> None:
    """Raise UserError unless labels belong to a run's task and, in all that labels depend on, to its world."""
    if (name := head.get("name")) != task.name:
        raise UserError(f"{path} holds labels of {name}, but the task is {task.name}: give labels of the same task")
    theirs, ours = configuration.to_json(configuration.from_json(task.config, head)), configuration.to_json(world)
    if apart := [name for name in ours if theirs[name] != ours[name] and name not in task.labels_hold]:
        raise UserError(
            f"{path} holds labels of a world with another task.{apart[0]} ({theirs[apart[0]]}; this run has "
            f"{ours[apart[0]]}): give labels of the same world"
        )
