"""Configuration of the method: frozen dataclasses, one line of help beside each field.

Three kinds of number, kept apart: `Sizes` shape the compiled program (another value compiles again), `Scalars` are
traced (another value costs nothing), `Schedule` counts steps on the host and the shared clock. The defaults are the
billiards hyper-parameters of the paper (appendix) and of its public code. `Sizes` and `Scalars` are the agent's, the
guide's and the simulated teacher's together, on one level of options; what concerns one of them takes that part alone.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

import jax

TaskT = TypeVar("TaskT")

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
    """Directions of a first look while learning, evenly spaced; the argmax over the set is then taken near its peaks
    (0: over all of the set, as every finished policy takes it)."""
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
    aim_layers: tuple[int, ...] = (32, 32)
    """Hidden layers of a guidance model that weighs the task's aims: the same ones for every aim."""
    labels_per_round: int = 10
    """New labels after which the guidance model is fitted again from scratch."""
    fit_steps: int = 2000
    """Adam steps of one fit (a fixed number, so that all seeds take equally long)."""
    fit_batch_size: int = 100
    """Labels in one step of a fit."""
    validate_every: int = 20
    """Adam steps between two looks at the validation labels (every fifth label); the best parameters are kept."""
    guide_directions: int = 360
    """Directions over which a guide that values actions takes its argmax."""
    replay_steps: int = 5
    """Gradient steps on earlier corrections after each new one, of a guide that goes on learning (deep COACH)."""
    ensemble: int = 1
    """Members of the guidance model, each fitted to all labels; it predicts their mean."""
    candidates: int = 1
    """Situations among which each question is chosen, where the members of an ensemble disagree most (1: as they
    come)."""
    ask_all: bool = False
    """Is every candidate asked about, in place of one that is chosen? Simulated labels by the thousand are then soon
    asked for: a round takes its number of questions divided by `candidates` in steps."""
    question_every: int = 1
    """Steps from one question of a simulated teacher to the next (1: every situation is asked about): questions farther
    apart are of more different situations."""


@dataclass(frozen=True)
class Sizes(GuideSizes, AgentSizes):
    """Static sizes: changing one compiles the program again."""

    pace: bool = False
    """Does the share of guided episodes follow whether they earn more than the agent's own?"""
    lanes_per_block: int = 0
    """Seeds trained in one block, side by side (0: all) on an accelerator, one by one (0: a block a core) on a CPU."""


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
    action_noise_deg: float = 0.0
    """Every action that is not drawn uniformly is turned by a normal angle of this standard deviation while the agent
    learns [deg]."""


@dataclass(frozen=True)
class GuideScalars(_Clipping):
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
    explored_fraction: float = 0.25
    """Share of the questions that a guide which values actions asks about base actions even so, to find good ones."""
    correction_replay: int = 50
    """Newest corrections that a guide which goes on learning (deep COACH) keeps learning from."""
    aim_doubt: float = 2.0
    """A guide that reads intent leaves actions as they are where it is at least so many times likelier that no aim is
    meant."""
    ask_bound_deg: float = 180.0
    """From the second instalment on: questions and guided episodes stay within this of the agent's own action [deg]."""
    guided_probability: float = 0.5
    """Probability that an episode is guided."""


@dataclass(frozen=True)
class TeacherFaults:
    """Scalars of a simulated teacher: what it answers about, and how it errs; traced, but for words."""

    answer: Literal["best", "nearest"] = "best"
    """What it has in mind: its best action, or of those that it holds for good the nearest to the one asked about."""
    nearest_share: float = 0.6
    """Good is an action worth at least this share of the best one."""
    nearest_aim_deg: float = 1.0
    """Standard deviation of the error of aim over which that worth is averaged [deg]."""
    scalar_within_deg: float = 5.0
    """Scalar feedback calls good what lies so near the action in mind [deg]."""
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
    pace_lead: float = 0.0
    """With sizes.pace: what guided episodes must earn more than own ones to have their whole share; below it the share
    is proportional (0: any lead will do)."""


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

    @property
    def noisy(self) -> bool:
        """Are actions turned at random while the agent learns?"""
        return self.scalars.action_noise_deg > 0
