"""What `cuelearner adapt` is asked for, whether it makes sense, and the way from there to a policy folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_jax.adaptation import adapting, judging, program, stored
from cuelearner_jax.adaptation.adapting import Adaptation, Adapted, Judging
from cuelearner_jax.config import GuideSizes, RunConfig, Scalars, Sizes, check_guide
from cuelearner_jax.errors import UserError, closest
from cuelearner_jax.evaluate import Tell, untold
from cuelearner_jax.feedback.answers import check_teacher
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.guides.relative import KIND
from cuelearner_jax.policies import Common
from cuelearner_jax.runs import adapted, trained
from cuelearner_jax.runs.grid import Grid, check_grid
from cuelearner_jax.runs.order import Order as RunOrder
from cuelearner_jax.runs.order import read_labels
from cuelearner_jax.runs.trained import PolicySource
from cuelearner_jax.storage import label_files, policy_folders
from cuelearner_jax.terminal import console

DEFAULT_KIND = KIND.name
MOST_ENVS = 100_000  # that memory has room for


@dataclass(frozen=True)
class Base:
    """Which lanes of the folder are adapted."""

    policy: str = "agent"
    """Which of its policies, see above."""
    guidance: str | None = None
    """Kind of guidance of the lanes (default: the run's last)."""
    labels: int | None = None
    """Their label budget (default: the largest)."""
    bound_deg: float | None = None
    """Of a policy folder: their bound (default: the largest) [deg]."""
    seeds: tuple[int, ...] = ()
    """Their seeds; several are adapted side by side, each with its own (default: the first lane)."""


@dataclass(frozen=True)
class Order:
    """What is asked for."""

    source: PolicySource
    code: Any  # a policy from outside, to be adapted in place of one of the source's; None: none
    named: str | None  # package.module:NAME of the code, its own or that in the source's folder
    world: Any  # the changed world, a configuration of the task's
    robot: str | None  # the source's task acts with it; None: its own
    out: Path
    labels: tuple[int, ...]
    bounds_deg: tuple[float, ...]  # none: as far as the labels of the file reach, or else `adapting.BOUND_DEG`
    seeds: tuple[int, ...]
    kind: str  # of guidance
    labels_from: Path | None
    judge_by: str
    judge_episodes: int
    judge_every: int
    judge_bounds: tuple[float, ...]
    overwrite: bool
    base: Base
    sizes: GuideSizes
    scalars: Scalars


def run(order: Order, watch: Callable[[str], Tell] = lambda what: untold) -> Adapted:
    """Adapts and writes the policy folder, whose place is kept for this process from now on.

    Raises UserError for what cannot be adapted; nothing has then been written.
    """
    with policy_folders.place_of(order.out, order.overwrite) as place:
        found, origin = _adapted(order, watch)
        path = order.labels_from
        used = {"labels_from": f"{path.name} {label_files.digest(path)}" if path else None, "robot": order.robot}
        adapted.write(place, found, order.source.task, order.world, origin, used)
    return found


def _adapted(order: Order, watch: Callable[[str], Tell]) -> tuple[Adapted, dict[str, Any]]:
    """What adaptation leads to, and what was adapted in plain values. Raises UserError for what cannot be adapted."""
    task, sizes, scalars = order.source.task, order.sizes, order.scalars
    check_guide(sizes, scalars)
    kind = guidances.resolve(order.kind)
    if not kind.asks:
        raise UserError(f"guidance {kind.name!r} asks nothing that could be learned from: choose another --guidance")
    env = task.environment(order.world)
    guidance = guidances.make(kind.name, sizes, env)
    bases, seeds, origin = _bases(order, env)
    shared = isinstance(bases, Common)
    if not shared and order.seeds != (0,):
        raise UserError("several base policies are adapted each with its own seed: leave out --seeds and --first-seed")
    seeds = order.seeds if shared else seeds
    check_grid(Grid((kind.name,), seeds, order.labels))
    file = _label_file(order, kind.name, seeds)
    bounds = order.bounds_deg or (_reach(bases, file, scalars) if file else adapting.BOUND_DEG,)
    if note := adapting.check_angles(bounds, scalars):
        console.print(note)
    each = program.one_each(seeds, order.labels, bounds)
    lanes = program.product(1, seeds, order.labels, bounds) if shared else each
    how = _judging(order, env)
    teacher = None if file else task.make_teacher(order.world, env)
    if teacher is not None:
        check_teacher(teacher, scalars)
    asked = Adaptation(guidance, sizes, scalars, env, bases, lanes, how)
    stored.told(program.adapted(guidance, sizes, env, scalars, bases, program.begin(guidance, sizes, env, lanes)))
    labels = None
    if file:
        slots = program.rounds(lanes, sizes) * sizes.labels_per_round
        labels = label_files.for_lanes(file, lanes.seed, lanes.budget, slots)
    return adapting.adapt(asked, teacher, labels, watch=watch), origin


def _bases(order: Order, env: Any) -> tuple[Any, tuple[int, ...], dict[str, Any]]:
    """The base policies, their seeds, and what they are in plain values."""
    source, base = order.source, order.base
    if order.code is not None:
        _try(order.code, env, order.named)
        return Common(order.code), (0,), {"code": order.named}
    chosen = {"base.guidance": base.guidance, "base.labels": base.labels, "base.seeds": base.seeds}
    source.check(base.policy, order.world, **chosen, **{"base.bound-deg": base.bound_deg})
    if trained.POLICIES[base.policy].taught:
        raise UserError(f"policy {base.policy!r} asks the teacher, so there is nothing to adapt: choose another")
    if len(set(base.seeds)) < len(base.seeds):
        raise UserError("--base.seeds: give each seed once")
    policies, seeds = trained.several(
        source, env, order.world, base.policy, base.guidance, base.labels, base.seeds, base.bound_deg
    )
    told = {name: value for name, value in dataclasses.asdict(base).items() if value not in (None, ())}
    origin = {"folder": source.folder.name, **told, "seeds": list(seeds)}
    if order.named:
        origin["code"] = order.named
    return Common(policies[0]) if len(policies) == 1 else program.side_by_side(policies), seeds, origin


def _try(policy: Any, env: Any, named: str | None) -> None:
    """Raises UserError if a policy from outside cannot act on the environment's observations."""
    try:
        # Shapes alone: of zeros a sound policy may make no direction.
        jax.eval_shape(lambda obs: policy.act(jax.random.key(0), None, obs), jnp.zeros((1, env.obs_size)))
    except UserError:
        raise
    except Exception as error:  # whatever the user's own code raises
        told = (str(error).strip().splitlines() or [""])[0][:200]
        raise UserError(
            f"{named} fails on observations (1, {env.obs_size}) ({type(error).__name__}: {told}): mend it first"
        ) from error


def _label_file(order: Order, kind: str, seeds: tuple[int, ...]) -> label_files.LabelFile | None:
    if order.labels_from is None:
        return None
    config = RunConfig(order.world, Sizes(**dataclasses.asdict(order.sizes)), order.scalars)
    grid = Grid((kind,), seeds, order.labels)
    return read_labels(RunOrder(order.source.task, config, grid, order.out, labels_from=order.labels_from))


def _reach(bases: Any, file: label_files.LabelFile, scalars: Scalars) -> float:
    """How far labels reach from what the base policy does [deg]; at least eps."""
    if not isinstance(bases, Common):
        raise UserError("labels of several base policies reach differently far: give --bound-deg")
    return max(adapting.reach(bases, file.labels.obs, file.labels.action), scalars.eps_deg)


def _judging(order: Order, env: Any) -> Judging:
    """How policies are judged. Raises UserError for what makes no sense."""
    task, by, envs = order.source.task, order.judge_by, order.judge_episodes
    if not 1 <= envs <= MOST_ENVS:
        raise UserError(f"--judge-episodes is {envs}: give a number from 1 to {MOST_ENVS:,}")
    unit = order.sizes.labels_per_round
    if order.judge_every < 0 or order.judge_every % unit:
        raise UserError(f"--judge-every is {order.judge_every}: give a multiple of sizes.labels_per_round ({unit})")
    judging.check_bounds(order.judge_bounds, by, "--judge-bounds")
    metrics = judging.metrics_of(env)
    if by not in (*metrics, judging.LABELS):
        raise UserError(f"--judge-by is {by!r}, no metric of {task.name}{closest(by, [*metrics, judging.LABELS])}")
    steps = task.longest(order.world) if task.longest else judging.STEPS
    plays = by != judging.LABELS or order.judge_every
    tuned = task.environment(order.world, "tuning") if plays else None
    return Judging(tuned, envs, envs * steps, by, order.judge_every, bounds=order.judge_bounds)


def _difference(lanes: np.ndarray) -> str:
    """Differences (lanes, 3) in words: one with its 95% interval, or how many of several exclude 0."""
    if len(lanes) > 1:
        return f"the difference's 95% interval lies above 0 in {int((lanes[:, 1] > 0).sum())} of {len(lanes)} lanes"
    ((estimate, lower, upper),) = lanes
    zero = ", which includes 0" if lower <= 0 <= upper else ""
    return f"difference {estimate:+.3g} [{lower:+.3g}, {upper:+.3g}]{zero}"


def _steps(lanes: np.ndarray) -> str:
    """Rewarded steps (lanes,) in words."""
    return f"{int(np.mean(lanes)):,} rewarded steps{'' if len(lanes) == 1 else ' a lane'}"


def told(found: Adapted) -> list[str]:
    """What adaptation has led to, a line for each budget and bound."""
    lanes, judged, lines = found.asked.lanes, found.judged, []
    for bound, budget in sorted({*zip(lanes.bound_deg.tolist(), lanes.budget.tolist(), strict=True)}):
        own = (lanes.bound_deg == bound) & (lanes.budget == budget)
        before, after = (f"{float(np.mean(values[own])):.4g}" for values in (judged.before, judged.after))
        if judged.by == judging.LABELS:
            worth, worse = f"predicts {after} of held-out answers, always 'already right' {before}", "fewer than that"
        else:
            worth, worse = f"{judged.by} on tuning episodes {before} before, {after} after", "worse than before"
            worth += f" ({_difference(judged.difference[own])}; {_steps(judged.rewarded_steps[own])})"
        lines.append(f"{budget} labels within {bound:g} degrees: {worth}")
        if narrowed := sorted({*judged.within_deg[own & judged.used].round(3).tolist()} - {round(bound, 3)}):
            lines[-1] += f", used within {' or '.join(f'{angle:g}' for angle in narrowed)} degrees"
        left = lanes.seed[own & ~judged.used]
        if len(left):
            which = f"seed {left[0]}" if len(left) == 1 else f"{len(left)} of {int(own.sum())} seeds"
            lines[-1] += f"; {which}: {worse}, so the model is not used and the policy stays what it was"
    return lines
