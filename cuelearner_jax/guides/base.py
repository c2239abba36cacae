"""The base class of guides, pure functions over an explicit model; and `Kind`, what the registry knows of a guide.

What a teacher *said* (its answer, kept in labels) and what a network *predicts* of it (the target) are two things.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback.forms import AnswerForm
from cuelearner_jax.guides.fitting import Lesson, fit_least_squares, lessons
from cuelearner_jax.guides.model import GuideModel, guide_model
from cuelearner_jax.guides.refining import Refinement, bound_scalars, refine
from cuelearner_jax.types import GuidanceModel, Label, Params

# pattern of names of kinds, also in files: neither a path nor a reference to code
NAME = re.compile(r"[a-z][a-z0-9_-]*")


@dataclass(frozen=True)
class Kind:
    """A kind of guidance, before sizes and an environment are known."""

    name: str  # name in options, folders and columns
    about: str  # description in a few words
    guide: type[Guide]
    form: AnswerForm | None = None  # form of the answers that it asks for; None: it never asks
    needs: tuple[str, ...] = ()  # optional members of an environment that it needs
    title: str = ""  # title in figures, if other than the name
    colour: str | None = None  # colour in figures
    config: type | None = None  # a frozen dataclass of the options that this kind alone has; None: it has none
    sees_base: bool = False  # True if it needs a finished policy's actions; it then serves adaptation only
    by_cues: bool = False  # True if its model measures along cues, whatever its answers say
    # True if `reading` reads its answers; it then has no model and serves adaptation only
    by_evidence: bool = False

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise ValueError(f"a guidance is called {self.name!r}: give lower-case letters, digits, - and _")

    @property
    def asks(self) -> bool:
        """Whether its guides ask a teacher."""
        return self.form is not None

    @property
    def needs_cues(self) -> bool:
        """Whether its guides need a space whose actions have cues."""
        return self.by_cues or (self.form is not None and self.form.by_eps)

    @property
    def adapts_only(self) -> bool:
        """Whether its guides correct finished policies only."""
        return self.sees_base or self.by_evidence

    def make(self, sizes: GuideSizes, spaces: Spaces, options: Any = None) -> Guide:
        """Return the guide for an environment's spaces; `options`: a `config` (None: its defaults)."""
        return self.guide(self, sizes, spaces, self.config() if options is None and self.config else options)


@dataclass(frozen=True)
class Guide:
    """One kind of guidance for one lane: pure functions over an explicit model, chosen in Python before tracing.

    A kind writes `act`, and `target` and `predict` where these differ. By default a network of situation and action,
    or an ensemble of such, is fitted from scratch to all labels by least squares (paper, Eq. 3), and questions are
    about what it would do (DAgger). Guides with equal settings are equal: a program is compiled once for them.
    """

    kind: Kind
    sizes: GuideSizes
    spaces: Spaces
    options: Any = None  # a `Kind.config`

    def __post_init__(self) -> None:
        """Raise UserError for a kind that needs cues, in a space without cues."""
        if self.kind.needs_cues and not self.spaces.actions.cues:
            told = "measures" if self.kind.by_cues else "asks"
            raise UserError(
                f"guidance {self.name!r} {told} which way to change an action, but the {self.spaces.actions.name} have "
                "no order: give them one (`Choices(count, order)`), or guidance demonstration or scalar"
            )

    @property
    def name(self) -> str:
        """Name of the guide's kind."""
        return self.kind.name

    @property
    def form(self) -> AnswerForm | None:
        """Form of the answers that the guide asks for; None: it never asks."""
        return self.kind.form

    @property
    def asks(self) -> bool:
        """Whether the guide asks a teacher."""
        return self.kind.asks

    @property
    def moves(self) -> bool:
        """Whether the guide ever changes an action."""
        return True

    @property
    def has_members(self) -> bool:
        """Whether the guide's model is an ensemble, whose members can disagree."""
        return self.asks and self.sizes.ensemble > 1

    @cached_property
    def network(self) -> GuideModel:
        """The network, or ensemble, whose outputs are added to an action."""
        return guide_model(self.sizes, self.spaces)

    def target(self, label: Label, scalars: GuideScalars) -> Float[Array, " outputs"]:
        """Return what the network is to predict for one label; here the answer."""
        return label.answer

    def predict(
        self, env: Any, params: Params, obs: Float[Array, "n obs"], actions: Float[Array, "n action"]
    ) -> Float[Array, "n outputs"]:
        """Return the predictions that are fitted to the targets."""
        return self.network.predict(env, params, obs, actions)

    def act(
        self,
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, "n obs"],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refinement:
        """Return the actions to execute in place of a batch of actions.

        Rows that are not active do not change. Without a fitted model no row changes, if the guide asks for labels.
        """
        raise NotImplementedError(f"{type(self).__name__} does not say how it acts: write `act`")

    def init(self, key: PRNGKeyArray) -> GuidanceModel:
        """Return an unfitted model."""
        return GuidanceModel(self.network.init(key), jnp.array(False))

    def lessons(self, labels: Label, scalars: GuideScalars) -> Lesson:
        """Return labels (slots, ...) with their targets."""
        space = self.spaces.actions if self.form is not None and self.form.by_eps else None
        return lessons(labels, self.target, scalars, space)

    def redrawn(self, key: PRNGKeyArray, batch: Lesson) -> Lesson:
        """Return the batch to train on in place of a batch (n, ...) of lessons."""
        return batch

    def fit(
        self, key: PRNGKeyArray, env: Any, labels: Label, former: GuidanceModel, scalars: GuideScalars
    ) -> GuidanceModel:
        """Return the model of labels (slots, ...); fitting from scratch ignores `former`, the previous model."""
        rows, predict = self.lessons(labels, scalars), partial(self.predict, env)
        return fit_least_squares(
            key, rows, scalars, init=self.network.init, apply=predict, sizes=self.sizes, redrawn=self.redrawn
        )

    def question(
        self,
        key: PRNGKeyArray,
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, " obs"],
        base: Float[Array, " action"],
        scalars: GuideScalars,
    ) -> Float[Array, " action"]:
        """Return the action to ask about: refined from `base` in a share `refined_fraction` of questions, else `base`.

        Source: DAgger (Ross, Gordon, Bagnell, 2011): what is asked about follows what will be met.
        """
        refines = jax.random.bernoulli(key, scalars.refined_fraction)
        return self.act(model, env, obs[None], base[None], refines[None], scalars).actions[0]

    def disagreement(
        self, model: GuidanceModel, env: Any, obs: Float[Array, "n obs"], actions: Float[Array, "n action"]
    ) -> Float[Array, " n"]:
        """Return the variance of an ensemble's members, summed over their outputs."""
        return self.network.disagreement(env, model.params, obs, actions)

    def refine_labelled_actions(
        self, model: GuidanceModel, env: Any, labels: Label, active: Bool[Array, " n"], scalars: GuideScalars
    ) -> Refinement:
        """Return what `act` makes of the actions that labels (n, ...) are about."""
        return self.act(model, env, labels.obs, labels.action, active, scalars)

    def act_within(
        self,
        bound: Float[Array, ""],
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, "n obs"],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refinement:
        """Return `act`, limited to within `bound` of the given actions for every kind."""
        space = self.spaces.actions
        moved = self.act(model, env, obs, actions, active, bound_scalars(space, scalars, bound))
        return moved._replace(actions=space.clip(moved.actions, actions, bound))

    def refined(
        self,
        residual: Callable[[Float[Array, "n action"]], Float[Array, "n action"]],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
        k_max: Int[Array, ""] | int | None = None,
    ) -> Refinement:
        """Return `refine` within the limits of the scalars; `k_max`: another largest number of passes."""
        space = self.spaces.actions
        return refine(
            residual,
            actions,
            active,
            space=space,
            tau=space.from_unit(scalars.tau_deg),
            tau_max=space.from_unit(scalars.tau_max_deg),
            k_max=scalars.k_max if k_max is None else k_max,
        )
