"""Options that all parts share: frozen dataclasses, bounds and one line of help beside each field.

Three kinds of number, kept apart: `Sizes` shape the compiled program (another value compiles again), `Scalars` are
traced (another value costs nothing), `Schedule` counts steps on the host and the shared clock. The defaults are the
billiards hyper-parameters of the paper (appendix) and of its public code. What one part alone needs is its own
(`config.parts`): an agent's, an arbiter's, a kind of guidance's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import jax.numpy as jnp

from cuelearner_jax.config.parts import POSITIVE, SHARE, Bounds, Layers, check_multiple, check_part, register
from cuelearner_jax.errors import UserError

Frame = Literal["raw", "action"]


@dataclass(frozen=True)
class GuideSizes:
    """Static sizes of the guidance model and of its fitting."""

    frame: Frame = "raw"
    """Inputs of networks: raw, the observation and the action; action, the observation as seen from the action (a guide
    then predicts a turn from there)."""
    feedback_layers: Layers = (400, 400, 300, 300)
    """Hidden layers of the guidance model."""
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
    """Environments of one seed that step together before as many gradient steps follow."""
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
    """Teacher's fault: with this probability a relative answer has the wrong sign, a demonstration is mirrored at the
    action asked about, and a good action is called bad or a bad one good."""
    silence_probability: Annotated[float, SHARE] = 0.0
    """Teacher's fault: no answer, of any form, with this probability (the question still counts as a label)."""
    indifference_deg: Annotated[float, Bounds(0)] = 0.0
    """Teacher's fault: errors up to this count as right (relative feedback implies at least eps / 2); the action asked
    about is then demonstrated, and called good [deg]."""
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

    def learned_from(self, step: Any) -> Any:
        """Return the number of environment steps, of the first `step`, that gradient steps followed; traced or not."""
        return jnp.maximum(step - self.learn_after, 0)


for _group in (GuideScalars, TeacherFaults, Scalars, Schedule):
    register(_group, int)


def check_guide(sizes: GuideSizes, scalars: GuideScalars) -> None:
    """Raise UserError with one line for the first value of the guide's configuration that cannot work."""
    check_part(sizes, "sizes")
    check_part(scalars, "scalars")
    check_multiple(sizes.fit_steps, sizes.validate_every, "sizes.fit_steps", "sizes.validate_every")
    if sizes.ask_all and sizes.candidates == 1:
        raise UserError(
            "sizes.ask_all asks about every candidate: give sizes.candidates above 1 too, or leave out sizes.ask_all"
        )
    if sizes.ask_all:
        check_multiple(sizes.labels_per_round, sizes.candidates, "sizes.labels_per_round", "sizes.candidates")
    elif sizes.candidates > 1 and sizes.ensemble == 1:
        raise UserError(
            f"sizes.candidates is {sizes.candidates}: questions are chosen by the disagreement of members, so give a "
            "sizes.ensemble above 1 too, or sizes.ask_all"
        )
