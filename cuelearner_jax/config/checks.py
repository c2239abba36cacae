"""What values of a configuration can work: one clear line for the first that cannot."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from cuelearner_jax.config.groups import AgentSizes, GuideScalars, GuideSizes, RunConfig
from cuelearner_jax.config.plain import fits, plain
from cuelearner_jax.errors import UserError, closest, shown

LARGEST = 2**31 - 1  # counters and indices are 32-bit integers
LARGEST_ROUND = 1 << 30  # so that budgets of as many labels, in whole rounds, are such an integer too
LARGEST_FLOAT = 3.4028234e38  # scalars are computed in single precision
MOST_LAYERS = 64  # each is compiled by itself

GroupT = TypeVar("GroupT")


def check(config: RunConfig) -> None:
    """Raises UserError with one line for the first value that cannot work."""
    sizes, schedule = config.sizes, config.schedule
    check_types(schedule, "schedule")
    check_whole(schedule, "schedule")
    check_agent(sizes)
    if sizes.lanes_per_block < 0:
        raise UserError(
            f"sizes.lanes_per_block is {sizes.lanes_per_block}: give a positive number, or 0 to leave it open"
        )
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


def check_types(group: Any, prefix: str, **changes: Any) -> dict[str, Any]:
    """Values that fields of a configuration are to get, as they are kept: NumPy's numbers as Python's, lists as tuples.

    Args:
        group: a configuration, or its class.
        prefix: what messages call it.
        changes: the values by field (default: those that the configuration holds).

    Raises:
        UserError: no such field, or a value of another type than its field's.
    """
    fields = [field.name for field in dataclasses.fields(group) if field.init]
    kinds = get_type_hints(group if isinstance(group, type) else type(group))
    values = changes or {name: getattr(group, name) for name in fields}
    kept = {}
    for name, given in values.items():
        if name not in fields:
            raise UserError(f"{prefix} has no field {shown(name)}{closest(name, fields)}")
        value = plain(given)
        kind = kinds[name]
        if not fits(value, kind):
            words = " or ".join(map(str, get_args(kind))) if get_origin(kind) is Literal else ""
            raise UserError(f"{prefix}.{name} is {shown(value)}: give {words or f'a value of type {_called(kind)}'}")
        kept[name] = value
    return kept


def settled(group: GroupT, prefix: str) -> GroupT:
    """A configuration with its values as they are kept. Raises UserError as `check_types`."""
    kept = check_types(group, prefix)
    changed = {name: value for name, value in kept.items() if value is not getattr(group, name)}
    return dataclasses.replace(group, **changed) if changed else group  # pyright: ignore[reportArgumentType]


def _called(kind: Any) -> str:
    return kind.__name__ if isinstance(kind, type) and not get_args(kind) else str(kind)


def check_whole(group: Any, prefix: str) -> None:
    """Raises UserError for a whole number that 32 bits do not hold."""
    for field in dataclasses.fields(group):
        value = getattr(group, field.name)
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, int) and abs(number) > LARGEST:
                raise UserError(
                    f"{prefix}.{field.name} is {number}: give at most {LARGEST}, which is counted in 32 bits"
                )


def check_agent(sizes: AgentSizes) -> None:
    """Raises UserError with one line for the first value of an agent's that cannot work."""
    check_types(sizes, "sizes")
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
    _check_layers(sizes.q_layers, "sizes.q_layers")
    if sizes.n_step * sizes.num_envs > sizes.replay_capacity:
        raise UserError(
            f"sizes.n_step is {sizes.n_step}: give at most {sizes.replay_capacity // sizes.num_envs}, the steps of an "
            "environment that sizes.replay_capacity holds"
        )


def check_guide(sizes: GuideSizes, scalars: GuideScalars) -> None:
    """Raises UserError with one line for the first value of a guide's that cannot work."""
    for group, prefix in ((sizes, "sizes"), (scalars, "scalars")):
        check_types(group, prefix)
        check_whole(group, prefix)
    positive = (
        "labels_per_round",
        "fit_steps",
        "fit_batch_size",
        "validate_every",
        "ensemble",
        "candidates",
        "question_every",
    )
    _check_positive(sizes, (*positive, "guide_directions", "replay_steps"))
    _check_choice(sizes)
    if sizes.labels_per_round > LARGEST_ROUND:
        raise UserError(f"sizes.labels_per_round is {sizes.labels_per_round}: give at most {LARGEST_ROUND}")
    _check_layers(sizes.feedback_layers, "sizes.feedback_layers")
    _check_layers(sizes.aim_layers, "sizes.aim_layers")
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


def _check_choice(sizes: GuideSizes) -> None:
    """Of the situations to ask in."""
    if sizes.ask_all and sizes.candidates == 1:
        raise UserError("sizes.ask_all asks about every candidate: give sizes.candidates above 1 too, or leave it out")
    if sizes.ask_all:
        _check_multiple(sizes.labels_per_round, sizes.candidates, "sizes.labels_per_round", "sizes.candidates")
    elif sizes.candidates > 1 and sizes.ensemble == 1:
        raise UserError(
            f"sizes.candidates is {sizes.candidates}: questions are chosen by the disagreement of members, so give a "
            "sizes.ensemble above 1 too, or sizes.ask_all"
        )


def _check_positive(sizes: Any, names: tuple[str, ...]) -> None:
    for name in names:
        if getattr(sizes, name) < 1:
            raise UserError(f"sizes.{name} is {getattr(sizes, name)}: give a positive number")


def _check_layers(layers: tuple[int, ...], name: str) -> None:
    if not 1 <= len(layers) <= MOST_LAYERS or min(layers) < 1:
        raise UserError(f"{name}: give at least one layer of positive width, at most {MOST_LAYERS}")


def _check_numbers(scalars: Any) -> None:
    for name, value in dataclasses.asdict(scalars).items():
        if isinstance(value, str):
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
