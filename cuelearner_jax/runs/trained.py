"""Policies by name, from a trained run, a policy folder or a task alone, and the choice among lanes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cuelearner_jax.adaptation.by_model import plain_scalars
from cuelearner_jax.environment import actions_of, check_layout, offers, spaces_of, view_of
from cuelearner_jax.errors import UserError, format_numbers, suggestion
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.policies import (
    Agent,
    Corrected,
    Guided,
    Heuristic,
    Policy,
    Taught,
    asked_from,
    policy_of,
    uniform_in,
)
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs.adapted import AdaptedLanes, open_folder
from cuelearner_jax.runs.failures import select, without_failed
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.run_folders import Piece, RunLanes, lanes_of, open_run
from cuelearner_jax.storage import label_files, policy_folders, results
from cuelearner_jax.task import Task, shape_of
from cuelearner_jax.terminal import console
from cuelearner_jax.types import Teacher


class Named(NamedTuple):
    """A policy that can be chosen by name."""

    about: str
    trained: bool = False  # whether the policy needs a run
    adapted: bool = False  # whether the policy needs a policy folder
    taught: bool = False  # whether the policy asks the teacher
    needs: tuple[str, ...] = ()  # optional members of an environment that the policy needs

    @property
    def kept(self) -> bool:
        """Whether the policy comes from a folder."""
        return self.trained or self.adapted


POLICIES: dict[str, Named] = {
    "agent": Named("the trained agent", trained=True),
    "guide": Named("guidance of uniform actions", trained=True),
    "guided": Named("guidance of the agent's actions", trained=True),
    "corrected": Named("the teacher's own feedback on the agent's actions", trained=True, taught=True),
    "adapted": Named("the adapted policy", adapted=True),
    "base": Named("the policy that was adapted", adapted=True),
    "teacher": Named("the teacher", taught=True),
    "heuristic": Named("the task's obvious action", needs=("heuristic",)),
    "uniform": Named("chance"),
    "own": Named("code of your own, package.module:NAME, named first"),
}


class Block(NamedTuple):
    """Lanes of one kind of guidance at one step, and the policies that they act with."""

    guidance: str
    seeds: np.ndarray  # (lanes,)
    budgets: np.ndarray  # (lanes,)
    bounds: np.ndarray  # (lanes,), in the space's unit; 0: no bound
    step: int
    policy: Any  # a block, or `Common`
    failed: np.ndarray  # (lanes,) bool


Chosen = tuple[str | None, int | None, tuple[int, ...]]  # guidance, labels and seeds; None and (): open


class ChosenLanes(NamedTuple):
    """A choice among lanes; empty: all."""

    guidance: tuple[str, ...] = ()
    labels: tuple[int, ...] = ()
    seeds: tuple[int, ...] = ()

    def mask(self, lanes: Any) -> np.ndarray:
        """Return which lanes (lanes,), with their seeds and budgets, are chosen."""
        return np.isin(lanes.seeds, self.seeds or lanes.seeds) & np.isin(lanes.budgets, self.labels or lanes.budgets)


@dataclass(frozen=True)
class PolicySource:
    """The origin of policies: a run folder, a policy folder, or a task alone."""

    task: Task
    config: RunConfig
    grid: Grid | None
    folder: Path
    pieces: tuple[Piece, ...] = ()  # shards of a run; empty: the whole run lies in its folder
    adapted: AdaptedLanes | None = None  # of a policy folder
    code: Any = None  # a policy of the user's own

    @classmethod
    def of_folder(
        cls, folder: Path, find: Callable[[str], Task], code: Any = None, changes: Any = None
    ) -> PolicySource:
        """Return the policies of a run, whole or in shards (`open_run`), or of a policy folder (`open_folder`).

        `code`, `changes`: the code that a policy folder names. Raises UserError if the folder is neither, cannot be
        read, or needs no code where some is given.
        """
        if not policy_folders.is_one(folder):
            task, config, grid, pieces = open_run(folder, find)
            if code is not None:
                raise UserError(f"{folder} is a run, without code in its policies: leave out --base")
            return cls(task, config, grid, folder, pieces)
        task, world, lanes = open_folder(folder, find, code, changes)
        scalars = plain_scalars(actions_of(shape_of(task, world)))
        return cls(_with_labels(task, folder), RunConfig(world, scalars=scalars), None, folder, adapted=lanes)

    @property
    def default_policy(self) -> str:
        """The policy that acts where none is named."""
        if self.adapted:
            return "adapted"
        if self.code is not None:
            return "own"
        return "agent" if self.grid else "heuristic"

    def on(self, robot: str | None) -> PolicySource:
        """Return the source with another robot of the task (None: the default). Raises UserError if unknown."""
        return replace(self, task=self.task.on(robot))

    def check(self, policy: str, changed: Any, guidance: str | tuple[str, ...] | None = None) -> None:
        """Raise UserError unless the policy is available and acts in the changed world.

        A trained policy needs the observations and aims of its training world; other policies act in any world.
        `guidance`: chosen kinds of a run's lanes.
        """
        if policy not in POLICIES:
            raise UserError(f"unknown policy {policy!r}{suggestion(policy, POLICIES)}")
        named, after = POLICIES[policy], shape_of(self.task, changed)
        if named.trained and not self.grid:
            others = [name for name, one in POLICIES.items() if not one.kept or (one.adapted and self.adapted)]
            raise UserError(f"policy {policy!r} needs a trained run: give a run folder, or one of {', '.join(others)}")
        if named.adapted and not self.adapted:
            raise UserError(f"policy {policy!r} needs a policy folder: give one that `cuelearner adapt` wrote")
        if policy == "own" and self.code is None:
            raise UserError("policy 'own' is code: name it first, as package.module:NAME --env TASK")
        if lacking := [need for need in named.needs if not offers(after, need)]:
            raise UserError(f"{self.task.name} has no {lacking[0]}: choose another policy")
        if not named.kept:
            check_no_lane(policy, guidance)
            return
        what, known = "run" if self.grid else "policy", shape_of(self.task, self.config.task)
        check_layout(f"the {what}", known.observation, actions_of(known), after)
        if policy in ("agent", "corrected"):
            return
        chosen = (guidance,) if isinstance(guidance, str) else guidance
        kinds = self.adapted.kinds if self.adapted else chosen or (self.grid.guidance if self.grid else ())
        weighs_aims = any("aims" in kind.needs for name in kinds if (kind := guidances.guides().get(name)))
        if weighs_aims and (width := spaces_of(known).aims) != (now := spaces_of(after).aims):
            raise UserError(
                f"the {what} uses aims of {width} features, this world's have {now}: keep the options that set the aims"
            )

    def load(self, kinds: tuple[str, ...] = ()) -> list[RunLanes]:
        """Return the lanes of a run's kinds of guidance (none named: all), grouped by step.

        Raises UserError for a kind that the run lacks, or if there is no checkpoint.
        """
        assert self.grid is not None  # ensured by `check`
        loaded = []
        for name in kinds or self.grid.guidance:
            if name not in self.grid.guidance:
                raise UserError(f"{self.folder} has no guidance {name!r}: choose among {', '.join(self.grid.guidance)}")
            if name not in guidances.guides():
                raise UserError(
                    f"{self.folder} has lanes of a guidance outside the package, {name!r}: name its code by "
                    "--guidance package.module:NAME, if you trust that code"
                )
            pieces = self.pieces or (Piece(self.folder, self.grid),)
            loaded += lanes_of(self.task, self.config, pieces, name, sweep=pieces[0].folder != self.folder)
        return loaded

    def alone(self, name: str, view: Any, teacher: Teacher | None = None) -> Policy:
        """Return a policy that belongs to no lane, in a view of a world; `teacher`: that world's."""
        if name == "own":
            return policy_of(self.code, actions_of(view))
        if name == "teacher":
            assert teacher is not None
            return Taught(teacher)
        return Heuristic(view) if name == "heuristic" else uniform_in(view)

    def blocks(
        self, name: str, view: Any, teacher: Teacher | None, only: ChosenLanes, failed_too: bool = False
    ) -> list[Block]:
        """Return a policy of the folder, in blocks of lanes (`only`: of some kinds, and of a run's budgets and seeds).

        `view`, `teacher`: those of the world that it acts in. Raises UserError if it is not available.
        """
        kinds = only.guidance
        if (kept := self.adapted) is not None:
            if kinds and kept.guidance not in kinds:
                raise UserError(f"{self.folder} was adapted by {kept.guidance} guidance: leave out --guidance")
            policy = kept.policy(view)
            policy = policy if name == "adapted" else policy.base
            columns = (kept.lanes.seed, kept.lanes.budget, kept.bounds_deg)
            return [Block(kept.guidance, *columns, 0, policy, np.zeros(kept.lanes.number, bool))]
        masks = [(lanes, only.mask(lanes)) for lanes in self.load(kinds)]
        loaded, blocks = [select(lanes, mask) for lanes, mask in masks if mask.any()], []
        if not loaded and (grid := self.grid):
            there = f"seeds {format_numbers(grid.seeds)} and labels {format_numbers(grid.labels)}"
            raise UserError(f"{self.folder} has no such lane: there are {there}")
        for lanes in loaded if failed_too else without_failed(loaded):
            policy, failed = self._acting(name, lanes, view, teacher), np.asarray(lanes.policies["failed"])
            columns = (lanes.seeds, lanes.budgets, np.zeros(len(lanes.seeds)))
            blocks.append(Block(lanes.guidance.name, *columns, lanes.step, policy, failed))
        return blocks

    def _acting(self, name: str, lanes: RunLanes, view: Any, teacher: Teacher | None) -> Policy:
        """Return a trained policy of a run's lanes, as a block."""
        config = self.config
        agent = Agent(lanes.policies["params"], config.agent_in(view), view)
        if name == "agent":
            return agent
        if name == "corrected":
            assert teacher is not None
            return Corrected(agent, teacher, config.scalars, actions_of(view))
        base = asked_from(view, config.sizes) if name == "guide" else agent
        return Guided(base, lanes.policies["guidance"], view, config.scalars, lanes.guidance)


def _with_labels(task: Task, folder: Path) -> Task:
    """Return a policy folder's task; without recorded situations in its configuration, those of its labels are used."""
    body = task.bodies[0]
    if body.filled is None:
        return task

    def environment(config: Any, split: str) -> Any:
        if task.files(config) or label_files.found_in(folder) is None:
            return body.environment(config, split)
        rows = label_files.read(folder).labels
        return body.filled(config, rows.obs, rows.action)  # pyright: ignore[reportOptionalCall]

    return replace(task, bodies=(replace(body, environment=environment), *task.bodies[1:]))


def check_no_lane(policy: str, *choices: Any) -> None:
    """Raise UserError if there is a choice of a lane for a policy without lanes."""
    if any(choice not in (None, ()) for choice in choices):
        raise UserError(f"policy {policy!r} belongs to no lane of a run: leave out the options that choose a lane")


def chosen_lane(source: PolicySource, name: str, choice: Chosen) -> Chosen:
    """Return a choice, its open parts filled from the run's lane with the best last reward in validation, and print it.

    Raises UserError if the run has several lanes to choose among and no results.
    """
    grid, (kind, labels, seeds) = source.grid, choice
    kind = kind and guidances.kind_name(kind)
    if grid is None or not POLICIES[name].trained or len(grid.guidance) * len(grid.seeds) * len(grid.labels) == 1:
        return choice
    try:
        table = results.read(source.folder).select([*results.LANE, "step", "reward"]).sort_by("step")
    except UserError as error:
        raise UserError(f"{error}; or choose the lane by --guidance, --labels and --seed") from error
    last = {tuple(row[part] for part in results.LANE): row["reward"] for row in table.to_pylist()}
    fits = [lane for lane in last if kind in (None, lane[0]) and labels in (None, lane[1])]
    fits = [lane for lane in fits if not seeds or lane[2] in seeds]
    if not fits:
        return choice
    best = max(fits, key=lambda lane: -np.inf if last[lane] is None else last[lane])
    if len({lane[:2] for lane in fits}) > 1 or (len(fits) > 1 and not seeds):
        console.print(
            f"{source.folder}: {best[0]}, {best[1]} labels, seed {best[2]} has the best validated reward of "
            f"{len(fits)} lanes; --guidance, --labels and --seed choose another"
        )
    return best[0], best[1], seeds or best[2:]


def one_policy(
    source: PolicySource,
    world: Any,
    name: str,
    kind: str | None,
    labels: int | None,
    seed: int | None,
    bound_deg: float | None = None,
    env: Any = None,
) -> Any:
    """Return a single policy: of one lane of a folder, or of the task. Raises UserError without such a lane."""
    seeds = () if seed is None else (seed,)
    return several(source, world, name, kind, labels, seeds, bound_deg, env)[0][0]


def several(
    source: PolicySource,
    world: Any,
    name: str,
    kind: str | None,
    labels: int | None,
    seeds: tuple[int, ...],
    bound_deg: float | None = None,
    env: Any = None,
) -> tuple[list[Any], tuple[int, ...]]:
    """Return single policies of a folder's lanes that differ only in their seeds, and the seeds.

    A policy of the task alone has seed 0.

    Args:
        source: the policies' origin.
        world: the world they are to act in.
        name: name of the policy.
        kind, labels, seeds: kind of guidance, budget and seeds (None, empty: those of `chosen_lane` in a run, of a
            policy folder the largest budget and the first seed).
        bound_deg: bound of a policy folder's lanes (None: the largest).
        env: that world's environment, for a teacher (default: with its training episodes).

    Raises:
        UserError: there is no such lane.
    """
    named = POLICIES[name]
    if named.taught and env is None:
        env = source.task.environment(world)
    teacher = source.task.make_teacher(world, env) if named.taught else None
    view = source.task.view(world) if env is None else view_of(env)
    if not named.kept:
        check_no_lane(name, kind, labels, seeds, bound_deg)
        return [source.alone(name, view, teacher)], (0,)
    kind, labels, seeds = chosen_lane(source, name, (kind, labels, seeds))
    kinds = (guidances.kind_name(kind),) if kind else ()
    blocks = source.blocks(name, view, teacher, ChosenLanes(kinds), failed_too=True)
    budget = int(max(block.budgets.max() for block in blocks)) if labels is None else labels
    bound = float(max(block.bounds.max() for block in blocks)) if bound_deg is None else bound_deg
    seeds = seeds or (int(blocks[0].seeds[0]),)
    return [_lane(blocks, seed, budget, bound, actions_of(view).unit) for seed in seeds], seeds


def _lane(blocks: list[Block], seed: int, budget: int, bound: float, unit: str) -> Any:
    """Return the policy of a lane. Raises UserError if no block has the lane."""
    for block in blocks:
        within = np.isclose(block.bounds, bound, rtol=1e-4)
        for index in np.flatnonzero((block.seeds == seed) & (block.budgets == budget) & within)[:1].tolist():
            if block.failed[index]:
                console.print(f"seed {seed} failed, no longer finite: this is its last finite state")
            return block.policy.lane(index)
    seeds, budgets, bounds = (
        format_numbers(np.concatenate([getattr(block, part) for block in blocks]).tolist())
        for part in ("seeds", "budgets", "bounds")
    )
    within, others = (f" within {bound:g} {unit}", f" within {bounds} {unit}") if bound else ("", "")
    raise UserError(
        f"no lane with seed {seed} and {budget} labels{within}: there are seeds {seeds} and labels {budgets}{others}"
    )
