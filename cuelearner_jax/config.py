"""Configuration of the method: frozen dataclasses, one line of help beside each field.

Three kinds of number, kept apart: `Sizes` shape the compiled program (another value compiles again), `Scalars` are
traced (another value costs nothing), `Schedule` counts steps on the host and the shared clock. The defaults are the
billiards hyper-parameters of the paper (appendix) and of its public code. `Sizes` and `Scalars` are the agent's, the
guide's and the simulated teacher's together, on one level of options; what concerns one of them takes that part alone.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import math
from dataclasses import dataclass
from types import UnionType
from typing import Any, Generic, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import jax
import jax.numpy as jnp

from cuelearner_jax.errors import UserError

TaskT = TypeVar("TaskT")

LARGEST = 2**31 - 1  # counters and indices are 32-bit integers
LARGEST_ROUND = 1 << 30  # so that budgets of as many labels, in whole rounds, are such an integer too
LARGEST_FLOAT = 3.4028234e38  # scalars are computed in single precision


Frame = Literal["raw", "action"]


@dataclass(frozen=True)
class _Seeing:
    """What the networks of the agent and of the guide share."""

    frame: Frame = "raw"
    """What networks see: observation and action as they are, or the observation as it looks from the action (and
    a guide then says by how much to turn from there)."""


@dataclass(frozen=True)
class AgentSizes(_Seeing):
    """Static sizes of the agent."""

    q_layers: tuple[int, ...] = (400, 400, 400, 300, 300, 300)
    """Hidden layers of the action-value network."""
    directions: int = 3600
    """Directions over which the agent takes its argmax (3600: every 0.1 deg)."""
    coarse_directions: int = 0
    """Directions of a first look, evenly spaced; the argmax over the set is then taken near its peaks (0: over all
    of the set)."""
    coarse_dtype: Literal["float32", "bfloat16"] = "float32"
    """Arithmetic of the first look (bfloat16 is twice as fast on an accelerator); the choice is made in float32."""
    peaks: int = 8
    """Peaks of the first look that are looked at closely."""
    target_directions: int = 720
    """Directions of the argmax inside bootstrapped targets (unused at discount 0)."""
    target_dtype: Literal["float32", "bfloat16"] = "float32"
    """Arithmetic of that argmax (bfloat16 is twice as fast on an accelerator); values are float32 either way."""
    num_envs: int = 1
    """Environments of one seed that step together before as many gradient steps follow."""
    batch_size: int = 100
    """Transitions in a gradient step."""
    replay_capacity: int = 10_000_000
    """Transitions kept (a multiple of num_envs)."""
    optimizer: Literal["sgd", "adam"] = "sgd"
    """Optimiser of the action-value network."""
    n_step: int = 1
    """Steps of the n-step return that is averaged with the one-step return (1: the one-step return alone)."""
    updates_per_step: int = 1
    """Gradient steps for each environment step."""


@dataclass(frozen=True)
class GuideSizes(_Seeing):
    """Static sizes of the guidance model and of its fitting."""

    feedback_layers: tuple[int, ...] = (400, 400, 300, 300)
    """Hidden layers of the guidance model."""
    labels_per_round: int = 10
    """New labels after which the guidance model is fitted again from scratch."""
    fit_steps: int = 2000
    """Adam steps of one fit (a fixed number, so that all seeds take equally long)."""
    fit_batch_size: int = 100
    """Labels in one step of a fit."""
    validate_every: int = 20
    """Adam steps between two looks at the validation labels (every fifth label); the best parameters are kept."""
    ensemble: int = 1
    """Members of the guidance model, each fitted to all labels; it predicts their mean."""
    candidates: int = 1
    """Situations among which each question is chosen: where the members disagree most (1: as they come)."""
    guide_directions: int = 360
    """Directions over which a guide that values actions takes its argmax."""
    replay_steps: int = 5
    """Gradient steps on earlier corrections after each new one, of a guide that goes on learning (deep COACH)."""


@dataclass(frozen=True)
class Sizes(GuideSizes, AgentSizes):
    """Static sizes: changing one compiles the program again."""

    pace: bool = False
    """Does the share of guided episodes follow whether they earn more than the agent's own?"""
    lanes_per_block: int = 0
    """Seeds trained in one block, side by side (0: all) on an accelerator, one by one (0: a block a core) on a CPU."""


class _Degrees:
    """Mixed into scalars of which some are angles in degrees."""

    def radians(self, name: str) -> jax.Array:
        """The field `name` + `_deg`, in radians; traced where the field is."""
        return jnp.deg2rad(jnp.asarray(getattr(self, name + "_deg"), jnp.float32))


@dataclass(frozen=True)
class _Clipping:
    """What the agent and the guide share."""

    max_grad_norm: float = 0.5
    """Gradients are clipped to this global norm."""


@dataclass(frozen=True)
class AgentScalars(_Clipping):
    """Traced scalars of the agent."""

    learning_rate: float = 0.1
    """Step size of the action-value network."""
    discount: float = 0.0
    """Discount factor; at 0 no target network exists."""
    n_step_weight: float = 0.5
    """Share of the n-step return in a target; the rest is the one-step return."""
    polyak: float = 0.005
    """Rate at which the target network follows."""


@dataclass(frozen=True)
class GuideScalars(_Degrees, _Clipping):
    """Traced scalars of the guide: of fitting, of refining, and of what it asks about."""

    feedback_learning_rate: float = 1e-3
    """Adam's step size of the guidance model."""
    eps_deg: float = 5.0
    """Strength of one relative label: by how much the teacher turns an action [deg]."""
    tau_deg: float = 0.1
    """Refinement stops once a pass turns the action by less [deg]."""
    tau_max_deg: float = 180.0
    """Refinement never leaves this distance from the first action [deg]; 180: no bound."""
    k_max: int = 50
    """Largest number of refinement passes."""
    refined_fraction: float = 1.0
    """Share of the labels after the first fit asked about refined actions (DAgger); the rest about base actions."""
    ask_bound_deg: float = 180.0
    """From the second instalment on: questions and guided episodes stay within this of the agent's own action [deg]."""
    explored_fraction: float = 0.25
    """Share of the questions that a guide which values actions asks about base actions even so, to find good ones."""
    correction_replay: int = 50
    """Newest corrections that a guide which goes on learning (deep COACH) keeps learning from."""
    guided_probability: float = 0.5
    """Probability that an episode is guided."""


@dataclass(frozen=True)
class TeacherFaults(_Degrees):
    """Scalars of a simulated teacher: what it answers about, and how it errs; traced, but for words."""

    answer: Literal["best", "nearest"] = "best"
    """What it has in mind: its best action, or of those that it holds for good the nearest to the one asked about."""
    nearest_share: float = 0.6
    """Good is an action worth at least this share of the best one."""
    nearest_aim_deg: float = 1.0
    """Standard deviation of the error of aim over which that worth is averaged [deg]."""
    scalar_good: Literal["near", "scored"] = "near"
    """Scalar feedback calls good what lies near the action in mind, or what is rewarded at once as well."""
    scalar_within_deg: float = 5.0
    """Scalar feedback: how near that is [deg]."""
    mistake_probability: float = 0.0
    """Teacher's fault: with this probability a turn is told the wrong way round, a demonstration errs on the other side
    of the action asked about, good is called bad and bad good."""
    silence_probability: float = 0.0
    """Teacher's fault: no answer, of any form, with this probability (the question still counts as a label)."""
    indifference_deg: float = 0.0
    """Teacher's fault: errors up to this pass for right (relative feedback alone implies eps / 2): the action asked
    about is then the one demonstrated, and called good [deg]."""
    teacher_bias_deg: float = 0.0
    """Teacher's fault: constant error, counterclockwise, of what it takes for the best action or for a good one,
    whatever the form of its answers [deg]."""


@dataclass(frozen=True)
class Scalars(TeacherFaults, GuideScalars, AgentScalars):
    """Traced scalars: changing one needs no new compile."""

    pace_window: float = 200.0
    """With sizes.pace: episodes, own and guided together, within which what they earned fades to 1/e."""
    pace_floor: float = 0.02
    """With sizes.pace: least share of guided episodes, and of own ones, so that both go on being seen."""


@dataclass(frozen=True)
class Schedule:
    """Counts of environment steps of one seed."""

    total_steps: int = 10_000_000
    """Environment steps of each seed."""
    random_steps: int = 10_000
    """First steps, with uniform actions."""
    learn_after: int = 1_000
    """Steps before the first gradient step."""
    guidance_until: int = 500_000
    """Step at which guidance is cut off."""
    target_every: int = 2
    """Gradient steps between two moves of the target network."""
    eval_every: int = 10_000
    """Steps between two evaluations."""
    eval_steps: int = 10_000
    """Environment steps of one evaluation."""
    eval_envs: int = 100
    """Environments that share an evaluation's steps."""
    checkpoint_every: int = 1_000_000
    """Steps between two checkpoints, which is what a killed run may lose."""
    ask_at: tuple[int, ...] = (0,)
    """Steps before which an equal instalment of the labels is asked for, the first 0: about uniform actions; later
    ones about the agent's own."""
    guide_eval_every: int = 0
    """Labels between two evaluations of the guide alone (0: after each instalment alone)."""


for _traced in (AgentScalars, GuideScalars, TeacherFaults, Scalars, Schedule):
    _names = [field.name for field in dataclasses.fields(_traced)]
    _words = [name for name in _names if isinstance(getattr(_traced, name), str)]  # no numbers: part of the program
    jax.tree_util.register_dataclass(_traced, [name for name in _names if name not in _words], _words)


@dataclass(frozen=True)
class RunConfig(Generic[TaskT]):
    """Everything that determines a run but its lanes (seeds, label budgets) and its kind of guidance."""

    task: TaskT
    sizes: Sizes = dataclasses.field(default_factory=Sizes)
    scalars: Scalars = dataclasses.field(default_factory=Scalars)
    schedule: Schedule = dataclasses.field(default_factory=Schedule)

    @property
    def bootstraps(self) -> bool:
        """Do targets look at the next observation?"""
        return self.scalars.discount > 0


def check(config: RunConfig) -> None:
    """Raises UserError with one line for the first value that cannot work."""
    sizes, schedule = config.sizes, config.schedule
    check_whole(schedule, "schedule")
    _check_sizes(sizes)
    check_guide(sizes, config.scalars)
    if config.scalars.pace_window < 1:
        raise UserError(f"scalars.pace_window is {config.scalars.pace_window}: give at least 1 episode")
    if config.scalars.pace_floor > 0.5:
        raise UserError(f"scalars.pace_floor is {config.scalars.pace_floor}: give at most 0.5, for both have it")
    if config.scalars.discount >= 1:
        raise UserError(f"scalars.discount is {config.scalars.discount}: give a number below 1")
    for name in ("total_steps", "eval_every", "eval_steps", "eval_envs", "checkpoint_every", "target_every"):
        if getattr(schedule, name) < 1:
            raise UserError(f"schedule.{name} is {getattr(schedule, name)}: give a positive number")
    for name in ("random_steps", "learn_after", "guidance_until"):
        if getattr(schedule, name) < 0:
            raise UserError(f"schedule.{name} is {getattr(schedule, name)}: give a number that is not negative")
    if schedule.total_steps * sizes.updates_per_step > LARGEST:
        raise UserError(
            f"schedule.total_steps is {schedule.total_steps}: give at most {LARGEST // sizes.updates_per_step}, or "
            "gradient steps (sizes.updates_per_step to each) cannot be counted"
        )
    if sizes.n_step > 1 and not config.bootstraps:
        raise UserError(f"sizes.n_step is {sizes.n_step}: n-step returns need a scalars.discount above 0")
    _check_multiple(schedule.eval_every, sizes.num_envs, "schedule.eval_every", "sizes.num_envs")
    _check_multiple(sizes.replay_capacity, sizes.num_envs, "sizes.replay_capacity", "sizes.num_envs")
    _check_multiple(schedule.total_steps, schedule.eval_every, "schedule.total_steps", "schedule.eval_every")
    _check_multiple(schedule.checkpoint_every, schedule.eval_every, "schedule.checkpoint_every", "schedule.eval_every")
    _check_multiple(schedule.eval_steps, schedule.eval_envs, "schedule.eval_steps", "schedule.eval_envs")
    _check_asking(config)


def _check_asking(config: RunConfig) -> None:
    """When labels are asked for, and when the guide is looked at."""
    schedule, scalars = config.schedule, config.scalars
    given = f"schedule.ask_at is {' '.join(map(str, schedule.ask_at)) or 'empty'}"
    if schedule.ask_at[:1] != (0,) or any(b <= a for a, b in itertools.pairwise(schedule.ask_at)):
        raise UserError(f"{given}: give steps in ascending order, the first of them 0")
    for step in schedule.ask_at:
        _check_multiple(step, schedule.eval_every, "schedule.ask_at", "schedule.eval_every")
    later = schedule.ask_at[1:]
    if later and later[-1] >= min(schedule.guidance_until, schedule.total_steps):
        end = "guidance_until" if schedule.guidance_until <= schedule.total_steps else "total_steps"
        raise UserError(
            f"{given}: give steps below schedule.{end} ({getattr(schedule, end)}), after which no guide acts"
        )
    if not 0 < scalars.ask_bound_deg <= 180:
        raise UserError(f"scalars.ask_bound_deg is {scalars.ask_bound_deg}: give an angle above 0 and up to 180")
    if not later and scalars.ask_bound_deg < 180:
        raise UserError(
            f"scalars.ask_bound_deg is {scalars.ask_bound_deg}, which bounds later instalments, and there is but one: "
            "add steps to schedule.ask_at, or leave it out"
        )
    if schedule.guide_eval_every < 0:
        raise UserError(f"schedule.guide_eval_every is {schedule.guide_eval_every}: give a number that is not negative")
    unit = config.sizes.labels_per_round
    _check_multiple(schedule.guide_eval_every, unit, "schedule.guide_eval_every", "sizes.labels_per_round")


def check_whole(group: Any, prefix: str) -> None:
    """Raises UserError for a whole number that 32 bits do not hold."""
    for field in dataclasses.fields(group):
        value = getattr(group, field.name)
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, int) and abs(number) > LARGEST:
                raise UserError(
                    f"{prefix}.{field.name} is {number}: give at most {LARGEST}, which is counted in 32 bits"
                )


def _check_sizes(sizes: Sizes) -> None:
    check_whole(sizes, "sizes")
    positive = ("directions", "peaks", "target_directions", "num_envs", "batch_size", "replay_capacity")
    _check_positive(sizes, (*positive, "updates_per_step", "n_step"))
    if sizes.coarse_directions and (sizes.coarse_directions < 3 or sizes.directions % sizes.coarse_directions):
        raise UserError(
            f"sizes.coarse_directions is {sizes.coarse_directions}: give a divisor of sizes.directions "
            f"({sizes.directions}) above 2, or 0 to look at all of them"
        )
    if sizes.coarse_directions and sizes.peaks > sizes.coarse_directions:
        raise UserError(f"sizes.peaks is {sizes.peaks}: give at most sizes.coarse_directions")
    if sizes.lanes_per_block < 0:
        raise UserError(
            f"sizes.lanes_per_block is {sizes.lanes_per_block}: give a positive number, or 0 to leave it open"
        )
    _check_layers(sizes.q_layers, "sizes.q_layers")
    if sizes.n_step * sizes.num_envs > sizes.replay_capacity:
        raise UserError(
            f"sizes.n_step is {sizes.n_step}: give at most {sizes.replay_capacity // sizes.num_envs}, the steps of an "
            "environment that sizes.replay_capacity holds"
        )


def check_guide(sizes: GuideSizes, scalars: GuideScalars) -> None:
    """Raises UserError with one line for the first value of a guide's that cannot work."""
    check_whole(sizes, "sizes")
    check_whole(scalars, "scalars")
    positive = ("labels_per_round", "fit_steps", "fit_batch_size", "validate_every", "guide_directions", "replay_steps")
    _check_positive(sizes, (*positive, "ensemble", "candidates"))
    if sizes.candidates > 1 and sizes.ensemble == 1:
        raise UserError(
            f"sizes.candidates is {sizes.candidates}: questions are chosen by the disagreement of members, so give a "
            "sizes.ensemble above 1 too"
        )
    if sizes.labels_per_round > LARGEST_ROUND:
        raise UserError(f"sizes.labels_per_round is {sizes.labels_per_round}: give at most {LARGEST_ROUND}")
    _check_layers(sizes.feedback_layers, "sizes.feedback_layers")
    _check_multiple(sizes.fit_steps, sizes.validate_every, "sizes.fit_steps", "sizes.validate_every")
    _check_numbers(scalars)
    if not 0 < scalars.eps_deg <= 180:
        raise UserError(
            f"scalars.eps_deg is {scalars.eps_deg}: a relative label is a turn of more than 0 and up to 180"
        )
    if scalars.correction_replay < 1:
        raise UserError(f"scalars.correction_replay is {scalars.correction_replay}: give a positive number")
    if scalars.max_grad_norm <= 0:  # a zero gradient would be scaled by 0 / 0
        raise UserError(f"scalars.max_grad_norm is {scalars.max_grad_norm}: give a positive number")


def _check_positive(sizes: Any, names: tuple[str, ...]) -> None:
    for name in names:
        if getattr(sizes, name) < 1:
            raise UserError(f"sizes.{name} is {getattr(sizes, name)}: give a positive number")


def _check_layers(layers: tuple[int, ...], name: str) -> None:
    if not layers or min(layers) < 1:
        raise UserError(f"{name}: give at least one layer of positive width")


def _check_numbers(scalars: Any) -> None:
    types = get_type_hints(type(scalars))
    for name, value in dataclasses.asdict(scalars).items():
        if get_origin(types[name]) is Literal:
            if not _fits(value, types[name]):
                raise UserError(f"scalars.{name} is {value!r}: give {' or '.join(get_args(types[name]))}")
            continue
        if name.endswith(("probability", "fraction", "share", "polyak", "weight")) and not 0 <= value <= 1:
            raise UserError(f"scalars.{name} is {value}: give a number from 0 to 1")
        if not math.isfinite(value) or abs(value) > LARGEST_FLOAT:
            raise UserError(f"scalars.{name} is {value}: give a finite number (in single precision)")
        if name != "teacher_bias_deg" and value < 0:
            raise UserError(f"scalars.{name} is {value}: give a number that is not negative")


def _check_multiple(value: int, unit: int, name: str, unit_name: str) -> None:
    if value % unit:
        raise UserError(f"{name} is {value}: give a multiple of {unit_name} ({unit})")


def to_json(config: Any) -> dict[str, Any]:
    """A configuration as plain JSON values."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def from_json(kind: type, values: dict[str, Any]) -> Any:
    """A flat configuration dataclass (Sizes, Scalars, Schedule, a task's) from JSON values; lists become tuples.

    Raises:
        UserError: an unknown field.
        TypeError: a value of another type than its field's.
    """
    known = {field.name for field in dataclasses.fields(kind)}
    unknown = sorted(set(values) - known)
    if unknown:
        raise UserError(
            f"unknown field {unknown[0]!r} for {kind.__name__}: the file was written by another version of cuelearner"
        )
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
    types = get_type_hints(kind)
    for name, value in values.items():
        if not _fits(value, types[name]):
            raise TypeError(f"{name} is {value!r}, not {types[name]}")
    return kind(**values)


def _fits(value: Any, kind: Any) -> bool:
    """Is a value of a field's type? Of the types that configurations have; every value is of any other."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Literal:
        return any(type(value) is type(choice) and value == choice for choice in parts)
    if origin in (Union, UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is tuple:
        parts = parts[:1] * len(value) if isinstance(value, tuple) and parts[1:] == (...,) else parts
        return isinstance(value, tuple) and len(value) == len(parts) and all(map(_fits, value, parts))
    if kind in (int, float):
        return type(value) is int or (kind is float and type(value) is float)
    return isinstance(value, kind) if isinstance(kind, type) else True


def digest(values: dict[str, Any]) -> str:
    """Short hash of JSON values: equal configurations have equal hashes."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:12]
