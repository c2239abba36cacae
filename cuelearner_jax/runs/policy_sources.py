"""Policies by name, from a trained run, a policy folder or a task alone, and the choice among lanes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from cuelearner_jax.adaptation.by_model import plain_scalars
from cuelearner_jax.environment import actions_of, check_layout, offers, spaces_of, view_of
from cuelearner_jax.errors import UserError, format_numbers, suggestion
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.policies import Agent, Corrected, Guided, Heuristic, Taught, asked_from, policy_of, uniform_in
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs.adapted import AdaptedLanes, open_folder
from cuelearner_jax.runs.failures import variant_name, without_failed
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.run_folders import Block, Piece, lanes_of, open_run
from cuelearner_jax.storage import label_files, policy_folders, results
from cuelearner_jax.task import Task, shape_of
from cuelearner_jax.terminal import console
from cuelearner_jax.types import Policy, Teacher

Choice = tuple[str | None, int | None, tuple[int, ...]]  # guidance, labels and seeds of lanes; None and (): open
OPTIONS = "--guidance, --labels and --seed (adapt, label: --base.guidance and so on)"  # that choose a lane


class PolicyEntry(NamedTuple):
    """A policy that can be chosen by name."""

    about: str
    from_run: bool = False  # whether the policy needs a run
    adapted: bool = False  # whether the policy needs a policy folder
    taught: bool = False  # whether the policy asks the teacher

    @property
    def from_folder(self) -> bool:
        """Whether the policy comes from a folder."""
        return self.from_run or self.adapted


POLICIES: dict[str, PolicyEntry] = {
    "agent": PolicyEntry("the trained agent", from_run=True),
    "guide": PolicyEntry("guidance of uniform actions", from_run=True),
    "guided": PolicyEntry("guidance of the agent's actions", from_run=True),
    "corrected": PolicyEntry("the teacher's own feedback on the agent's actions", from_run=True, taught=True),
    "adapted": PolicyEntry("the adapted policy", adapted=True),
    "base": PolicyEntry("the policy that was adapted", adapted=True),
    "teacher": PolicyEntry("the teacher", taught=True),
    "heuristic": PolicyEntry("the task's obvious action"),
    "uniform": PolicyEntry("chance"),
    "own": PolicyEntry("code of your own, package.module:NAME, named first"),
}


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
        """Return the policies of a run (see `open_run`) or a policy folder (see `open_folder` for all arguments)."""
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

    def check(self, policy: str, world: Any, guidance: tuple[str, ...] = ()) -> None:
        """Raise UserError unless the policy is available and acts in the changed world.

        A trained policy needs the observations and aims of its training world; other policies act in any world.
        `guidance`: chosen kinds of a run's lanes (none named: all).
        """
        if policy not in POLICIES:
            raise UserError(f"unknown policy {policy!r}{suggestion(policy, POLICIES)}")
        entry, after = POLICIES[policy], shape_of(self.task, world)
        if entry.from_run and not self.grid:
            raise UserError(f"policy {policy!r} needs a trained run: give a run folder, or another policy")
        if entry.adapted and not self.adapted:
            raise UserError(f"policy {policy!r} needs a policy folder: give one that `cuelearner adapt` wrote")
        if policy == "own" and self.code is None:
            raise UserError("policy 'own' is code: name it first, as package.module:NAME --env TASK")
        if policy == "heuristic" and not offers(after, "heuristic"):
            raise UserError(f"{self.task.name} has no heuristic: choose another policy")
        if not entry.from_folder:
            return
        what, own = "run" if self.grid else "policy", shape_of(self.task, self.config.task)
        check_layout(f"the {what}", own.observation, actions_of(own), after)
        if policy in ("agent", "corrected"):
            return
        kinds = self.adapted.kinds if self.adapted else guidance or (self.grid.guidance if self.grid else ())
        weighs_aims = any("aims" in kind.needs for name in kinds if (kind := guidances.guides().get(name)))
        if weighs_aims and (width := spaces_of(own).aims) != (now := spaces_of(after).aims):
            advice = "keep the options that set the aims"
            raise UserError(f"the {what} uses aims of {width} features, this world's have {now}: {advice}")

    def load(self, kinds: tuple[str, ...] = ()) -> list[Block]:
        """Return the lanes of a run's kinds of guidance (none named: all), grouped by step; see `lanes_of`."""
        assert self.grid is not None  # ensured by `check`
        groups = []
        for name in kinds or self.grid.guidance:
            if name not in self.grid.guidance:
                raise UserError(f"{self.folder} has no guidance {name!r}: choose among {', '.join(self.grid.guidance)}")
            if name not in guidances.guides():
                advice = "name its code by --guidance package.module:NAME, if you trust that code"
                raise UserError(f"{self.folder} has lanes of a guidance outside the package, {name!r}: {advice}")
            pieces = self.pieces or (Piece(self.folder, self.grid),)
            groups += lanes_of(self.task, self.config, pieces, name, sweep=pieces[0].folder != self.folder)
        return groups

    def alone(self, name: str, view: Any, teacher: Teacher | None = None) -> Policy:
        """Return a policy that belongs to no lane, in a view of a world; `teacher`: that world's."""
        if name == "own":
            return policy_of(self.code, actions_of(view))
        if name == "teacher":
            assert teacher is not None
            return Taught(teacher)
        return Heuristic(view) if name == "heuristic" else uniform_in(view)

    def blocks(
        self,
        name: str,
        view: Any,
        teacher: Teacher | None,
        kinds: tuple[str, ...] = (),
        labels: tuple[int, ...] = (),
        seeds: tuple[int, ...] = (),
        failed_too: bool = False,
    ) -> list[Block]:
        """Return a policy of the folder, in blocks of lanes of some kinds, budgets and seeds (none named: all).

        `view`, `teacher`: those of the world that it acts in. Raises UserError if it is not available.
        """
        if own := self.adapted:
            if kinds and own.guidance not in kinds:
                raise UserError(f"{self.folder} was adapted by {own.guidance} guidance: leave out --guidance")
            policy = own.policy(view)
            columns = (own.lanes.seed, own.lanes.budget, own.bounds_deg)
            policy = policy if name == "adapted" else policy.base
            blocks = [Block(own.guidance, *columns, 0, policy, np.zeros(own.lanes.number, bool))]
        else:
            blocks = [one._replace(policy=self._policy(name, one, view, teacher)) for one in self.load(kinds)]
        blocks = self.select(blocks, seeds, labels)
        return blocks if failed_too else without_failed(blocks)

    def select(
        self, blocks: list[Block], seeds: tuple[int, ...], labels: tuple[int, ...], bound: float = 0.0, unit: str = ""
    ) -> list[Block]:
        """Return the lanes with some seeds, budgets (empty: all) and a bound in a unit (0: any), or raise UserError."""
        rest = []
        for block in blocks:
            mask = np.isin(block.seeds, seeds or block.seeds) & np.isin(block.budgets, labels or block.budgets)
            mask &= np.isclose(block.bounds, bound, rtol=1e-4) | (bound == 0)
            if mask.any():
                rest.append(block.lanes(mask))
        there = [{*np.concatenate([getattr(block, part) for block in blocks]).tolist()} for part in Block._fields[1:4]]
        if rest and {*seeds} <= there[0] and {*labels} <= there[1]:
            return rest
        words = [f"seed {format_numbers(seeds)}"] * bool(seeds) + [f"{format_numbers(labels)} labels"] * bool(labels)
        near, others = (f" within {text} {unit}" if bound else "" for text in (f"{bound:g}", format_numbers(there[2])))
        why = f"there are seeds {format_numbers(there[0])} and labels {format_numbers(there[1])}{others}"
        raise UserError(f"{self.folder} has no lane with {' and '.join(words)}{near}: {why}")

    def _policy(self, name: str, block: Block, view: Any, teacher: Teacher | None) -> Any:
        config = self.config
        agent = Agent(block.policy["params"], config.agent_in(view), view)
        if name == "agent":
            return agent
        if name == "corrected":
            assert teacher is not None
            return Corrected(agent, teacher, config.scalars, actions_of(view))
        guide = config.guide_in(shape_of(self.task, config.task), block.guidance)
        base = asked_from(view, config.sizes) if name == "guide" else agent
        return Guided(base, block.policy["guidance"], view, config.scalars, guide)


def _with_labels(task: Task, folder: Path) -> Task:
    """Return a policy folder's task; without recorded situations in its configuration, those of its labels are used."""
    body = task.bodies[0]
    if body.filled is None:
        return task

    def environment(config: Any, split: str) -> Any:
        files = sorted(folder.glob("labels*.parquet"))  # one for each bound, about the same situations
        if task.files(config) or not files:
            return body.environment(config, split)
        rows = label_files.read(files[0]).labels
        return body.filled(config, rows.obs, rows.action)  # pyright: ignore[reportOptionalCall]

    return replace(task, bodies=(replace(body, environment=environment), *task.bodies[1:]))


def check_no_lane(policy: str, *choices: Any) -> None:
    """Raise UserError if there is a choice of a lane for a policy without lanes."""
    if any(choice not in (None, ()) for choice in choices):
        raise UserError(f"policy {policy!r} belongs to no lane of a run: leave out the options that choose a lane")


def best_lane(table: pa.Table, choice: Choice, metric: str = "reward") -> Choice:
    """Return a choice of lanes whose open parts are those of the lane with the best last value in a results table.

    Name that lane on the console. Raises UserError if several lanes fit and no value is recorded.
    """
    guidance, labels, seeds = choice
    rows = table.select([*results.LANE, "step", metric]).sort_by("step").to_pylist()
    last = {tuple(row[part] for part in results.LANE): row[metric] for row in rows}
    fits = [lane for lane in last if guidance in (None, lane[0]) and labels in (None, lane[1])]
    fits = [lane for lane in fits if not seeds or lane[2] in seeds]
    if len({lane[:2] if seeds else lane for lane in fits}) < 2:
        return (*fits[0][:2], seeds or fits[0][2:]) if fits else choice
    if not (finite := [lane for lane in fits if last[lane] is not None]):
        raise UserError(f"no {metric} is recorded that tells which of {len(fits)} lanes is the best: give {OPTIONS}")
    best = max(finite, key=last.__getitem__)
    console.print(
        f"{variant_name(*best[:2])}, seed {best[2]}: the best of {len(fits)} lanes by the last recorded {metric} "
        f"({last[best]:.4g}); {OPTIONS} choose another"
    )
    return (*best[:2], seeds or best[2:])


@dataclass(frozen=True, kw_only=True)
class LaneChoice:
    """Choice of a folder's policy, and of its lane, or of several lanes that differ in their seeds."""

    policy: str | None = None
    """Name of the acting policy, as for evaluate (default: the agent, or the adapted policy)."""
    guidance: str | None = None
    """Kind of guidance of the lane (default: that of the run's lane with the best last evaluation)."""
    labels: int | None = None
    """Label budget of the lane (default: that of the run's best lane; of a policy folder the largest)."""
    bound_deg: float | None = None
    """Bound of a policy folder's lane (default: the largest) [deg]."""
    seed: tuple[int, ...] = ()
    """Seed of the lane; several where lanes are adapted, each with labels of its own (default: that of the run's best
    lane; of a policy folder the first)."""

    def name_in(self, source: PolicySource, world: Any) -> str:
        """Return the policy's name. Raises UserError if the source has no such policy, or none for that world."""
        name = self.policy or source.default_policy
        source.check(name, world, (self.guidance,) if self.guidance else ())
        return name

    def _with_best(self, source: PolicySource, name: str) -> Choice:
        """Return guidance, labels and seeds; what is open in a run is that of its best lane."""
        grid, kind = source.grid, guidances.kind_name(self.guidance) if self.guidance else None
        if grid and kind is None and len(grid.guidance) == 1:
            kind = grid.guidance[0]
        choice = kind, self.labels, self.seed
        if grid is None or (
            kind and (self.labels is not None or len(grid.labels) < 2) and (self.seed or len(grid.seeds) == 1)
        ):
            return choice
        try:
            guides = results.read_guides([source.folder]) if name == "guide" else None
            table = results.read(source.folder) if guides is None else guides
        except UserError as error:
            raise UserError(f"{error}; or choose the lane by {OPTIONS}") from error
        return best_lane(table, choice, "reward" if guides is None else "guide_reward")

    def lanes_in(self, source: PolicySource, world: Any, env: Any = None) -> tuple[list[Any], list[dict[str, Any]]]:
        """Return single policies, one a seed, and what chooses each lane: its "guidance", "labels" and "seed".

        A policy of the task alone has the seed 0. `env`: the world's environment, for a teacher (default: with its
        training episodes).
        """
        name = self.policy or source.default_policy
        entry, teacher = POLICIES[name], None
        if entry.taught:
            env = source.task.environment(world) if env is None else env
            teacher = source.task.make_teacher(world, env)
        view = source.task.view(world) if env is None else view_of(env)
        if not entry.from_folder:
            check_no_lane(name, self.guidance, self.labels, self.seed, self.bound_deg)
            return [source.alone(name, view, teacher)], [{"seed": 0}]
        kind, labels, seeds = self._with_best(source, name)
        blocks = source.blocks(name, view, teacher, (kind,) if kind else (), failed_too=True)
        labels = int(max(block.budgets.max() for block in blocks)) if labels is None else labels
        bound = float(max(block.bounds.max() for block in blocks)) if self.bound_deg is None else self.bound_deg
        policies, lanes, unit = [], [], actions_of(view).unit
        for seed in seeds or (int(blocks[0].seeds[0]),):
            lane = source.select(blocks, (seed,), (labels,), bound, unit)[0]
            if lane.failed[0]:
                console.print(f"seed {seed} failed, no longer finite: this is its last finite state")
            policies.append(lane.policy.lane(0))
            lanes.append({"guidance": lane.guidance, "labels": labels, "seed": seed})
        budgets = () if self.labels is None else (self.labels,)
        count = sum(len(one.seeds) for one in source.select(blocks, self.seed, budgets, self.bound_deg or 0.0, unit))
        if source.adapted and count > len(lanes):
            names = ", ".join(f"{variant_name(lane['guidance'], labels)}, seed {lane['seed']}" for lane in lanes)
            console.print(f"{names}: of {count} lanes the first with most labels and bound; {OPTIONS} choose another")
        return policies, lanes

    def lane_in(self, source: PolicySource, world: Any, env: Any = None) -> tuple[Any, dict[str, Any]]:
        """Return the single policy and what chooses its lane. Raises UserError for several seeds, or no such lane."""
        if len(self.seed) > 1:
            raise UserError(f"--seed has {len(self.seed)} values, but one policy acts: give one seed")
        (policy,), (lane,) = self.lanes_in(source, world, env)
        return policy, lane
