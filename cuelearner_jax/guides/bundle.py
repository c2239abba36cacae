"""What a form of guidance is: a bundle of pure functions, chosen in Python before tracing.

What a teacher *said* (its answer, kept in labels) and what a network is to *predict* of it (the target) are two things.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.config import GuideScalars
from cuelearner_jax.feedback.forms import AnswerForm
from cuelearner_jax.guides.refining import Refined
from cuelearner_jax.types import GuidanceModel, Label


@runtime_checkable
class InitFunction(Protocol):
    """An unfitted model."""

    def __call__(self, key: PRNGKeyArray) -> GuidanceModel:
        """The model."""
        ...


@runtime_checkable
class QuestionFunction(Protocol):
    """Which action to ask about in a situation."""

    def __call__(
        self,
        key: PRNGKeyArray,
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, " obs"],
        base: Float[Array, " action"],
        scalars: GuideScalars,
    ) -> Float[Array, " action"]:
        """The action; `base` is what the base policy would do."""
        ...


@runtime_checkable
class TargetFunction(Protocol):
    """What the model is to predict of one label; `scalars` are with the label's own strength (`fitting.lessons`)."""

    def __call__(self, label: Label, scalars: GuideScalars) -> Float[Array, " outputs"]:
        """The target."""
        ...


@runtime_checkable
class FitFunction(Protocol):
    """The model of labels (slots, ...)."""

    def __call__(
        self, key: PRNGKeyArray, env: Any, labels: Label, former: GuidanceModel, scalars: GuideScalars
    ) -> GuidanceModel:
        """A model; `former` is the one before, which fitting from scratch does not look at."""
        ...


@runtime_checkable
class ActFunction(Protocol):
    """What to execute in place of a batch of actions."""

    def __call__(
        self,
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, "n obs"],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refined:
        """Rows that are not active stay as they are."""
        ...


@runtime_checkable
class OnwardFunction(Protocol):
    """What to execute in place of actions that have been corrected already."""

    def __call__(
        self,
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, "n obs"],
        first: Float[Array, "n action"],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refined:
        """As `ActFunction`, of `actions` that were `first` before anything corrected them."""
        ...


@runtime_checkable
class DisagreementFunction(Protocol):
    """How far the members of a model are apart."""

    def __call__(
        self, model: GuidanceModel, env: Any, obs: Float[Array, "n obs"], actions: Float[Array, "n action"]
    ) -> Float[Array, " n"]:
        """Of each row, not negative; 0 where they agree."""
        ...


class Guidance(NamedTuple):
    """One form of guidance for one lane: pure functions over an explicit model."""

    name: str
    form: AnswerForm | None  # of the answers that it asks for; None: it never asks
    init: InitFunction
    question: QuestionFunction
    target: TargetFunction
    fit: FitFunction
    act: ActFunction
    disagreement: DisagreementFunction | None = None  # None: its model has no members
    onward: OnwardFunction | None = None  # None: its model does not see what an action was before (`sizes.sees_turn`)

    @property
    def asks(self) -> bool:
        """Does it ask a teacher?"""
        return self.form is not None

    def moved_on(
        self,
        model: GuidanceModel,
        env: Any,
        labels: Label,
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refined:
        """What it would make of the actions that labels (n, ...) are about."""
        if self.onward is None:
            return self.act(model, env, labels.obs, labels.action, active, scalars)
        assert labels.base is not None  # of a guidance that sees it
        return self.onward(model, env, labels.obs, labels.base, labels.action, active, scalars)

    @property
    def answer_width(self) -> int:
        """Entries of one answer; 0 where nothing is asked."""
        return self.form.width if self.form else 0
