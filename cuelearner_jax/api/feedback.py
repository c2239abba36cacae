"""Fit a feedback model to labels, and refine policies by it, by default in rounds and within a bound.

A model knows only the actions in its labels. Labels about a policy's own actions alone say nothing of what refinement
then leads to; followed far, such a model makes the policy worse without a word. So `ask` questions in rounds, about
actions refined by the model so far (DAgger), and `refine` goes no farther than labels reach unless it is told to.
"""

from __future__ import annotations

import dataclasses
import math
import os
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cuelearner_jax import user_code
from cuelearner_jax.adaptation import by_model
from cuelearner_jax.adaptation.lanes import Adaptation, blame, product
from cuelearner_jax.agents.networks import all_finite
from cuelearner_jax.api.policies import CallablePolicy, as_policy, as_policy_in
from cuelearner_jax.api.worlds import World, numbers, teacher_of_world
from cuelearner_jax.config import GuideSizes, Scalars, check_guide, normalize_options
from cuelearner_jax.environment import Quantity, Spaces, spaces_of, view_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback import external_labels
from cuelearner_jax.feedback.answers import RELATIVE, check_teacher
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.guides.relative import Relative
from cuelearner_jax.policies import Common, Guided, policy_of
from cuelearner_jax.spaces import DIRECTIONS, Space, says_something
from cuelearner_jax.storage import label_files
from cuelearner_jax.types import GuidanceModel, Label, Teacher


class Labels(NamedTuple):
    """Labels as arrays: observations, the actions asked about, and the answers."""

    obs: Float[np.ndarray, "labels obs"]
    action: Float[np.ndarray, "labels action"]  # directions: unit vectors
    # h: of directions +1 counterclockwise ("more to the left"), 0 already right, -1 clockwise; (labels, cues) where a
    # space has several cues, `spaces.UNSAID` for a cue of which nothing was said
    answer: Float[np.ndarray, "labels *cues"]


@dataclasses.dataclass(frozen=True)
class FeedbackModel:
    """A model of relative feedback, fitted by `fit_feedback` or `ask`."""

    guidance: Guide
    model: GuidanceModel
    scalars: Scalars  # eps of the labels, and how actions are refined
    labels: Labels
    sizes: GuideSizes  # sizes that the guide was made with
    space: Space = DIRECTIONS  # space of the actions
    env: Any = None  # provides `features`, which the raw frame does not use


class LabelSet(NamedTuple):
    """Relative labels with what their file says of them."""

    rows: Label
    space: Space
    eps: float | None = None  # strength of an answer in the space's unit; None: not known
    task: dict[str, Any] = {}  # noqa: RUF012  # name and configuration of the labels' task; empty: not known

    def strength(self, eps: float | None) -> float | None:
        """Return the strength of the answers. Raises UserError for one that differs from the file's."""
        if self.eps is None or eps is None:
            return self.eps if eps is None else eps
        if not math.isclose(eps, self.eps, rel_tol=1e-6):
            raise UserError(f"the label file holds answers of {self.eps:g} {self.space.unit}: leave out eps")
        return self.eps


@user_code.report_user_errors
def fit_feedback(
    labels: Labels | str | os.PathLike[str],
    *,
    space: Space = DIRECTIONS,
    eps_deg: float | None = None,
    sizes: GuideSizes | None = None,
    scalars: Scalars | None = None,
    seed: int = 0,
) -> FeedbackModel:
    """Fit a feedback model to relative labels (paper, Eq. 3).

    Args:
        labels: arrays, or a label file (its first seed's).
        space: space of the actions in arrays; a file names its own.
        eps_deg: strength of an answer in the space's unit (default: of arrays 5 degrees, of a file the file's).
        sizes, scalars, seed: as for `adapt` (the paper's sizes are `config.GuideSizes()`).
    """
    label_set = LabelSet(rows_of(labels), space) if isinstance(labels, tuple) else labels_from_file(Path(labels))
    rows, spaces = rows_of(labels_of(label_set.rows)), Spaces(label_set.rows.obs.shape[1], label_set.space)
    if len(rows.obs) < 2:
        raise UserError(f"{len(rows.obs)} labels are too few to fit a model: give more labels")
    external_labels.check(rows, spaces, RELATIVE)
    sizes, scalars = settings(label_set.space, sizes, scalars, label_set.strength(eps_deg))
    guidance = Relative(sizes, spaces)
    k_init, k_fit = jax.random.split(jax.random.key(seed))
    fit = jax.jit(lambda key, rows, former, scalars: guidance.fit(key, None, rows, former, scalars))
    model = fit(k_fit, jax.tree.map(jnp.asarray, rows), guidance.init(k_init), scalars)
    if not all_finite(model):
        raise divergence_error()
    return FeedbackModel(guidance, model, scalars, labels_of(rows), sizes, label_set.space)


@user_code.report_user_errors
def ask(
    policy: Any,
    world: World,
    teacher: Teacher | Any,
    *,
    labels: int,
    bound_deg: float | None = None,
    eps_deg: float | None = None,
    sizes: GuideSizes | None = None,
    scalars: Scalars | None = None,
    seed: int = 0,
) -> FeedbackModel:
    """Ask a teacher about a policy's actions in rounds, each about actions refined by the model so far (DAgger).

    Args:
        policy, world, teacher: as for `adapt`.
        labels: number of questions.
        bound_deg: refined actions that are asked about stay within this of the policy's own, in the space's unit
            (default: a quarter of its reach, 45 degrees).
        eps_deg: strength of an answer in the space's unit (default: the scalars').
        sizes, scalars, seed: as for `adapt`.
    """
    env, space = world.env, world.actions
    sizes, scalars = settings(space, sizes, scalars, eps_deg)
    bound = by_model.usual_bound(space) if bound_deg is None else bound_deg
    by_model.check_amounts(space, [bound], scalars)
    if labels < 1:
        raise UserError(f"labels is {labels}: give a number above 0")
    teacher = teacher_of_world(teacher, space)
    check_teacher(teacher, scalars)
    user_code.answers_in("teacher", teacher, env)
    guidance = Relative(sizes, spaces_of(env))
    of = Adaptation(guidance, sizes, scalars, env, Common(as_policy_in(policy, env)))
    block = by_model.learn_lanes(of, product(1, (seed,), (labels,), (bound,)), teacher)
    if block.failed.any():
        blame(of, teacher, block)
        raise divergence_error()
    guide = jax.tree.map(lambda leaf: leaf[0], block.guide)
    return FeedbackModel(guidance, guide.model, scalars, labels_of(guide.labels), sizes, space, env)


@user_code.report_user_errors
def refine(policy: Any, model: FeedbackModel, bound_deg: float | None = None) -> CallablePolicy:
    """Return a policy whose actions are refined by a feedback model, within a bound (paper, Eqs. 2 to 5).

    Args:
        policy: the policy to refine, as for `ask`.
        model: a feedback model from `ask` or `fit_feedback`.
        bound_deg: how far refinement may lead from the policy's own actions, in the space's unit. By default as far as
            the labels reach: the distance within which 95% of the actions asked about lie from the policy's own, at
            least eps. A larger one is a warning: there the model was shown nothing.
    """
    space, labels, eps = model.space, model.labels, model.scalars.eps_deg
    base, width = policy_of(as_policy(policy), space), labels.obs.shape[1]
    observation = getattr(policy, "observation", ()) or (Quantity("observation", width, ""),)
    if width != (seen := sum(quantity.size for quantity in observation)):
        raise UserError(
            f"model takes observations with {width} entries, the policy's have {seen}: give a model fitted for it"
        )
    by_model.check_bounds(space, [] if bound_deg is None else [bound_deg])
    reach = max(by_model.reach(space, base, labels.obs, labels.action), eps)
    bound = reach if bound_deg is None else bound_deg
    if bound > reach * 1.05 and bound > eps:
        warnings.warn(
            f"the labels lie within {reach:.3g} {space.unit} of this policy's own actions, and refinement may lead "
            f"up to {bound:g} away, where the model was shown nothing and may make the policy worse: ask in rounds "
            "(cuelearner_jax.ask), or leave out bound_deg",
            stacklevel=2,
        )
    within = space.from_unit(bound)
    guided = Guided(base, model.model, view_of(model.env), model.scalars, model.guidance, within, model.sizes)
    return CallablePolicy(guided, observation, actions=space)


def settings(
    space: Space, sizes: GuideSizes | None, scalars: Scalars | None, eps_deg: float | None
) -> tuple[GuideSizes, Scalars]:
    """Return sizes and scalars, by default those of `by_model`. Raises UserError for values that cannot work."""
    sizes = normalize_options(sizes or by_model.SIZES, "sizes")
    scalars = normalize_options(by_model.settling(scalars or by_model.plain_scalars(space), eps_deg), "scalars")
    check_guide(sizes, scalars)
    return sizes, scalars


def labels_of(rows: Label) -> Labels:
    """Return a lane's valid labels as arrays."""
    given = jax.device_get(rows)
    obs, action, answer = (np.asarray(part)[given.valid] for part in (given.obs, given.action, given.answer))
    return Labels(obs, action, answer[:, 0] if answer.shape[1] == 1 else answer)


def rows_of(labels: Labels) -> Label:
    """Return labels as rows (labels, ...) of finite floats, without those that say nothing of any cue.

    Raises UserError unless they are three arrays of one length.
    """
    obs, action, answer = (numbers(f"labels.{name}", part) for name, part in zip(Labels._fields, labels, strict=True))
    if obs.ndim != 2 or not obs.size or action.shape[:1] != (len(obs),) or answer.shape[:1] != (len(obs),):
        raise UserError(
            f"labels have shapes {obs.shape}, {action.shape}, {answer.shape}: give observations (n, obs), "
            "actions (n, action) and answers (n,), or (n, cues) where there are several"
        )
    answer = answer[:, None] if answer.ndim == 1 else answer
    said = np.asarray(says_something(answer))
    if not said.any():
        raise UserError("labels say nothing of any cue: give labels with answers")
    return Label(obs[said], action[said], answer[said], np.ones(said.sum(), bool))  # pyright: ignore[reportArgumentType]


def labels_from_file(path: Path) -> LabelSet:
    """Return the labels of a file's first seed. Raises UserError for a file of other answers."""
    file = label_files.read(path)
    if file.answers != RELATIVE.name:
        raise UserError(f"{path} holds {file.answers} answers: give a file of {RELATIVE.name} ones")
    external_labels.check_file(file, None, RELATIVE, str(path))
    own = file.seeds == file.seeds[0]
    return LabelSet(jax.tree.map(lambda leaf: np.asarray(leaf)[own], file.labels), file.space, file.eps, file.task)


def divergence_error() -> UserError:
    """Return the UserError for a fit that is no longer finite."""
    return UserError("the fit of the feedback model diverged: lower scalars.feedback_learning_rate")
