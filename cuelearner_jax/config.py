"""Configuration: options that all parts share, options of single parts, their bounds, and their JSON form.

Options of a part (an agent, an arbiter, a kind of guidance) are one frozen dataclass, with bounds and help beside its
fields:

    @part
    class Config:
        layers: Layers = (64, 64)
        \"\"\"Hidden layers.\"\"\"
        learning_rate: Annotated[float, Bounds(0)] = 0.1
        \"\"\"Step size.\"\"\"

Floats, and whole numbers annotated with `TRACED`, are traced: another value costs no new compile. All other fields
shape the program. Of the options that all parts share, `Sizes` shape the compiled program, `Scalars` are traced, and
`Schedule` counts steps on the host and the shared clock. Their defaults are the billiards hyper-parameters of the paper
(appendix) and of its public code.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import typing
from dataclasses import dataclass
from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

import jax
import numpy as np
from jax.core import Tracer

from cuelearner_jax.errors import UserError, format_value, suggestion

LARGEST = 2**31 - 1  # counters and indices are 32-bit integers
LARGEST_FLOAT = 3.4028234e38  # scalars are computed in single precision
NUMBERS: dict[Any, str] = {int: "a whole number", float: "a number"}
TRACED = "traced"  # annotates a whole number that does not shape the program

PartT = TypeVar("PartT")


class Bounds(NamedTuple):
    """The range of numbers that a field may hold; for a tuple each of its entries."""

    least: float = -math.inf
    most: float = math.inf
    above: bool = False  # True if `least` itself is excluded

    def __contains__(self, number: object) -> bool:
        assert isinstance(number, int | float)
        return self.least <= number <= self.most and not (self.above and number == self.least)

    def __str__(self) -> str:
        """Describe the allowed numbers for a message."""
        if math.isinf(self.most):
            return "a positive number" if self.least or self.above else "a number that is not negative"
        least, most = (f"{bound:,}" if isinstance(bound, int) else f"{bound:g}" for bound in self[:2])
        return f"a number {'above' if self.above else 'from'} {least} {'and up ' if self.above else ''}to {most}"


POSITIVE = Bounds(1)  # bounds of whole numbers
SHARE = Bounds(0, 1)
EPISODE = Bounds(1, 1_000_000)  # of an episode's steps
Layers = Annotated[tuple[int, ...], POSITIVE]  # hidden widths of a network


@typing.dataclass_transform(frozen_default=True)
def part(kind: type[PartT]) -> type[PartT]:
    """Make a class a frozen dataclass of options, and a pytree of its floats."""
    options_class = dataclasses.dataclass(frozen=True)(kind)
    register(options_class)
    return options_class


def register(kind: type, *traced_too: type) -> None:
    """Register a dataclass as a pytree: floats, `TRACED` fields and those of `traced_too` are its leaves."""
    hints, extras = get_type_hints(kind), get_type_hints(kind, include_extras=True)
    names = [field.name for field in dataclasses.fields(kind)]
    traced = [name for name in names if hints[name] in (float, *traced_too) or TRACED in get_args(extras[name])]
    jax.tree_util.register_dataclass(kind, traced, [name for name in names if name not in traced])


def static(options: PartT) -> PartT:
    """Return the options with None in place of floats: what a program is compiled for."""
    return jax.tree.map(lambda leaf: None, options)


def check_types(group: Any, prefix: str, **changes: Any) -> dict[str, Any]:
    """Return a configuration's values, or `changes` of some: NumPy's numbers as Python's, lists as tuples.

    `prefix`: name of the configuration in messages.
    """
    fields = [field.name for field in dataclasses.fields(group) if field.init]
    kinds = get_type_hints(type(group))
    own = changes or {name: getattr(group, name) for name in fields}
    values = {name: plain(value) for name, value in own.items()}
    for name, value in values.items():
        if name not in fields:
            raise UserError(f"{prefix} has no field {format_value(name)}{suggestion(name, fields)}")
        if not fits(value, kind := kinds[name]):
            called = kind.__name__ if isinstance(kind, type) and not get_args(kind) else kind
            advice = f": give {NUMBERS.get(kind, f'a value of type {called}')}"
            advice = suggestion(str(value), get_args(kind)) if get_origin(kind) is Literal else advice
            raise UserError(f"{prefix}.{name} is {format_value(value)}{advice}")
    return values


def normalize_options(group: PartT, prefix: str) -> PartT:
    """Return a configuration with its values as `check_types` returns them. Raises UserError likewise."""
    return dataclasses.replace(group, **check_types(group, prefix))  # pyright: ignore[reportArgumentType]


def check_part(group: Any, prefix: str) -> None:
    """Raise UserError for the first field of a group with a value of the wrong type or out of bounds."""
    check_types(group, prefix)
    hints = get_type_hints(type(group), include_extras=True)
    for field in dataclasses.fields(group):
        value, name = getattr(group, field.name), f"{prefix}.{field.name}"
        bounds = next((extra for extra in get_args(hints[field.name]) if isinstance(extra, Bounds)), None)
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float) and not abs(number) <= LARGEST_FLOAT:
                raise UserError(f"{name} is {number}: give a finite number (in single precision)")
            if isinstance(number, int) and abs(number) > LARGEST:
                raise UserError(f"{name} is {number}: give at most {LARGEST}, which is counted in 32 bits")
            if bounds is not None and number not in bounds:
                raise UserError(f"{name} is {value}: give {bounds}")
        if bounds is not None and value == ():
            raise UserError(f"{name} is empty: give at least one layer")


def check_multiple(value: int, unit: int, name: str, unit_name: str) -> None:
    """Raise UserError unless a value is a multiple of `unit`."""
    if value % unit:
        raise UserError(f"{name} is {value}: give a multiple of {unit_name} ({unit})")


def plain(value: Any) -> Any:
    """Return numbers of NumPy and JAX as Python's, lists and arrays as tuples, and any other value unchanged."""
    if isinstance(value, np.ndarray | np.generic | jax.Array) and not isinstance(value, Tracer):
        value = value.tolist()
    return tuple(map(plain, value)) if isinstance(value, list | tuple) else value


def to_json(config: Any) -> dict[str, Any]:
    """Return a configuration as plain JSON values."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def from_json(kind: type, values: dict[str, Any]) -> Any:
    """Return a flat configuration dataclass (Sizes, Scalars, Schedule, a task's) from JSON values; lists become tuples.

    Ignores `name` and `from`. Raises UserError for an unknown field, or a value of another type than its field's.
    """
    hints, fields = get_type_hints(kind), {field.name for field in dataclasses.fields(kind)}
    values = {name: plain(value) for name, value in values.items() if name in fields or name not in ("name", "from")}
    for name, value in values.items():
        if name not in fields or not fits(value, hints[name]):
            raise UserError(f"{name} is {value!r} in a file of another version of cuelearner or of the task")
    return kind(**values)


def fits(value: Any, kind: Any) -> bool:
    """Return whether a value has a field's type. For types that no configuration uses, every value fits."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Literal:
        return any(type(value) is type(choice) and value == choice for choice in parts)
    if origin in (Union, UnionType):
        return any(fits(value, part) for part in parts)
    if origin is tuple:
        parts = parts[:1] * len(value) if isinstance(value, tuple) and parts[1:] == (...,) else parts
        return isinstance(value, tuple) and len(value) == len(parts) and all(map(fits, value, parts))
    if kind in (int, float):
        return (type(value) is int and abs(value) < 1 << 63) or (kind is float and type(value) is float)
    return isinstance(value, kind) if isinstance(kind, type) else True


def digest(values: dict[str, Any]) -> str:
    """Return a short hash of JSON values: equal configurations have equal hashes."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:12]


Frame = Literal["raw", "action"]
Start = Literal["xavier", "torch"]


@dataclass(frozen=True)
class GuideSizes:
    """Static sizes of the guidance model and of its fitting."""

    frame: Frame = "raw"
    """Inputs of networks: raw, the observation and the action; action, the observation as seen from the action (a guide
    then predicts a turn from there)."""
    normalise_obs: bool = True
    """Guides' networks see raw observations less their labels' mean, over their standard deviation."""
    feedback_layers: Layers = (400, 400, 300, 300)
    """Hidden layers of the guidance model."""
    feedback_start: Start = "xavier"
    """Initial weights of the guidance model: xavier, biases zero; torch, all uniform within 1 / sqrt(inputs)."""
    labels_per_round: Annotated[int, Bounds(1, 1 << 30)] = 10
    """New labels after which the guidance model is fitted again from scratch."""
    fit_steps: Annotated[int, POSITIVE] = 2000
    """Adam steps of one fit (a fixed number, so that all seeds take equally long)."""
    fit_batch_size: Annotated[int, POSITIVE] = 100
    """Labels in one step of a fit."""
    validate_every: Annotated[int, POSITIVE] = 20
    """Adam steps between two checks on the validation labels (every fifth label); the best parameters are kept."""
    ensemble: Annotated[int, POSITIVE] = 1
    """Members of the guidance model, each fitted to all labels; it predicts their mean."""
    candidates: Annotated[int, POSITIVE] = 1
    """Situations among which each question is chosen by the disagreement of an ensemble's members (1: no choice)."""
    ask_all: bool = False
    """Ask about every candidate instead of choosing one. This makes thousands of simulated labels fast: a round takes
    its number of questions divided by `candidates` in steps."""
    question_every: Annotated[int, POSITIVE] = 1
    """Steps between two questions of a simulated teacher (1: a question in every situation). Larger values give more
    diverse situations."""


@dataclass(frozen=True)
class Sizes(GuideSizes):
    """Static sizes: changing one compiles the program again."""

    num_envs: Annotated[int, POSITIVE] = 1
    """Environments of one seed that step together before gradient steps follow."""
    gradient_steps: Annotated[int, Bounds(0)] = 0
    """Gradient steps after each step of all environments (0: as many as environments)."""
    lanes_per_block: Annotated[int, Bounds(0)] = 0
    """Seeds trained in one block, side by side (0: all) on an accelerator, one by one (0: a block a core) on a CPU."""
    ask_from: Literal["uniform", "middle"] = "uniform"
    """Actions that questions begin with, before the guide refines them: uniform, or the middle of a box."""
    store_labelled: bool = False
    """Execute each asked action as its answer corrects it, and keep these rewarded steps for the agent to learn
    from."""


@dataclass(frozen=True)
class GuideScalars:
    """Traced scalars of the guide: of fitting, of refining, and of what it asks about."""

    max_grad_norm: Annotated[float, Bounds(0, above=True)] = 0.5
    """Gradients are clipped to this global norm, the agent's and the guide's."""
    feedback_learning_rate: Annotated[float, Bounds(0)] = 1e-3
    """Adam's step size of the guidance model."""
    eps_deg: Annotated[float, Bounds(0, 180, above=True)] = 5.0
    """Strength of one relative label: by how much the teacher turns an action [deg]."""
    tau_deg: Annotated[float, Bounds(0)] = 0.1
    """Refinement stops once a pass turns the action by less [deg]."""
    tau_max_deg: Annotated[float, Bounds(0)] = 180.0
    """Refinement never leaves this distance from the first action [deg]; 180: no bound."""
    k_max: Annotated[int, Bounds(0)] = 50
    """Largest number of refinement passes."""
    refined_fraction: Annotated[float, SHARE] = 1.0
    """Share of the labels after the first fit asked about refined actions (DAgger); the rest about base actions."""


@dataclass(frozen=True)
class TeacherFaults:
    """Scalars of a simulated teacher: what it answers about, and how it errs; traced, but for words."""

    answer: Literal["best", "nearest", "shuffled"] = "best"
    """The action that the teacher intends: best, its best action; nearest, the good action nearest to the one asked
    about; shuffled, a control: best, but models are fitted to labels with exchanged answers."""
    says: Literal["all", "worst", "one"] = "all"
    """The cues that a relative answer names: all, the worst (largest difference), or one at random. A cue that is not
    named does not count as "already right"."""
    nearest_share: Annotated[float, SHARE] = 0.6
    """An action is good if its value is at least this share of the best one's."""
    nearest_aim_deg: Annotated[float, Bounds(0)] = 1.0
    """Standard deviation of the error of aim over which these values are averaged [deg]."""
    scalar_within_deg: Annotated[float, Bounds(0)] = 5.0
    """Scalar feedback calls an action good within this distance of the intended one [deg]."""
    mistake_probability: Annotated[float, SHARE] = 0.0
    """Teacher's fault: with this probability a relative answer or a preference has the wrong sign, a demonstration is
    mirrored at the action asked about, and a good action is called bad or a bad one good."""
    silence_probability: Annotated[float, SHARE] = 0.0
    """Teacher's fault: no answer, of any form, with this probability (the question still counts as a label)."""
    indifference_deg: Annotated[float, Bounds(0)] = 0.0
    """Teacher's fault: errors up to this count as right (relative feedback implies at least eps / 2); the action asked
    about is then demonstrated, and called good. Errors of a pair that differ by less are no difference [deg]."""
    teacher_bias_deg: float = 0.0
    """Teacher's fault: constant error, counterclockwise, of the intended action, for every form of answers [deg]."""


@dataclass(frozen=True)
class Scalars(TeacherFaults, GuideScalars):
    """Traced scalars: changing one needs no new compile."""

    discount: Annotated[float, SHARE] = 0.0
    """Discount factor; at 0 nothing bootstraps from the next observation."""


@dataclass(frozen=True)
class Schedule:
    """Counts of environment steps of one seed."""

    total_steps: Annotated[int, POSITIVE] = 10_000_000
    """Environment steps of each seed."""
    random_steps: Annotated[int, Bounds(0)] = 10_000
    """First steps, with uniform actions."""
    learn_after: Annotated[int, Bounds(0)] = 1_000
    """Steps before the first gradient step."""
    guidance_until: Annotated[int, Bounds(0)] = 500_000
    """Step at which guidance is cut off."""
    eval_every: Annotated[int, POSITIVE] = 10_000
    """Steps between two evaluations."""
    eval_steps: Annotated[int, POSITIVE] = 10_000
    """Environment steps of one evaluation."""
    eval_envs: Annotated[int, POSITIVE] = 100
    """Environments that share an evaluation's steps."""
    checkpoint_every: Annotated[int, POSITIVE] = 1_000_000
    """Steps between two checkpoints; a killed run loses at most these."""
    guide_eval_every: Annotated[int, Bounds(0)] = 0
    """Labels between two evaluations of the guide alone (0: only after the last label)."""


for _group in (GuideScalars, TeacherFaults, Scalars, Schedule):
    register(_group, int)


def check_guide(sizes: GuideSizes, scalars: GuideScalars) -> None:
    """Raise UserError with one line for the first value of the guide's configuration that cannot work."""
    check_part(sizes, "sizes")
    check_part(scalars, "scalars")
    check_multiple(sizes.fit_steps, sizes.validate_every, "sizes.fit_steps", "sizes.validate_every")
    if sizes.ask_all and sizes.candidates == 1:
        raise UserError("sizes.ask_all asks about every candidate: give sizes.candidates above 1 too, or leave it out")
    if sizes.ask_all:
        check_multiple(sizes.labels_per_round, sizes.candidates, "sizes.labels_per_round", "sizes.candidates")
    elif sizes.candidates > 1 and sizes.ensemble == 1:
        raise UserError(
            f"sizes.candidates is {sizes.candidates}: questions are chosen by the disagreement of members, so give a "
            "sizes.ensemble above 1 too, or sizes.ask_all"
        )
