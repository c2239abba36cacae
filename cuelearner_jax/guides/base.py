"""Guides: pure functions over an explicit model. The base class of every kind, and the kinds that fit no model.

What a teacher *said* (its answer, kept in labels) and what a network *predicts* of it (the target) are two things.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback.answers import RELATIVE, AnswerForm
from cuelearner_jax.guides.fitting import Example, GuideModel, fit_model, guide_model, silent_cues, squared_errors
from cuelearner_jax.guides.refining import Refinement, bound_scalars, no_refinement, refine
from cuelearner_jax.spaces import is_answered
from cuelearner_jax.types import Action, Actions, GuidanceModel, Label, Observation, Observations, Params

Rows = Bool[Array, " n"]  # which rows

REFERENCES = 16  # actions over which the mean of an output is taken that labels do not tell


@dataclass(frozen=True)
class Guide:
    """One kind of guidance for one lane: pure functions over an explicit model, chosen in Python before tracing.

    A kind is a subclass with a `name`. It writes `act`, and `target` and `predict` where these differ. By default a
    network of situation and action, or an ensemble of such, is fitted from scratch to all labels by least squares
    (paper, Eq. 3), and questions are about what it would do (DAgger). Guides with equal settings are equal: a program
    is compiled once for them.
    """

    name: ClassVar[str]  # in options, folders and columns
    about: ClassVar[str]  # description in a few words
    form: ClassVar[AnswerForm | None] = None  # form of the answers that it asks for; None: it never asks
    needs: ClassVar[tuple[str, ...]] = ()  # optional members of an environment that it needs
    config: ClassVar[type | None] = None  # a dataclass (`config.part`) of options of its own; None: it has none
    title: ClassVar[str] = ""  # title in figures, if other than the name
    colour: ClassVar[str | None] = None  # colour in figures
    moves: ClassVar[bool] = True  # False if it never changes an action
    outputs: ClassVar[int | None] = None  # of its network, such as 1 for a value; None: a vector added to an action
    sees_base: ClassVar[bool] = False  # True if it needs a finished policy's actions; it then serves adaptation only
    compares: ClassVar[bool] = False  # True if labels tell its outputs' differences between actions alone
    by_cues: ClassVar[bool] = False  # True if its model measures along cues, whatever its answers say
    holds_out: ClassVar[bool] = True  # False if it learns every label, and none is held out for validation
    by_evidence: ClassVar[bool] = False  # True if `reading` reads its answers; it then serves adaptation only
    # From the above: whether it asks a teacher, needs a space with cues, corrects finished policies only
    asks: ClassVar[bool]
    needs_cues: ClassVar[bool]
    adapts_only: ClassVar[bool]

    sizes: GuideSizes
    spaces: Spaces
    options: Any = None  # a `config`; None: its defaults

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.asks = cls.form is not None
        cls.needs_cues = cls.by_cues or (cls.form is not None and cls.form.by_eps)
        cls.adapts_only = cls.sees_base or cls.by_evidence

    def __post_init__(self) -> None:
        """Raise UserError for a kind that needs cues, in a space without cues."""
        if self.needs_cues and not self.spaces.actions.cues:
            raise UserError(
                f"guidance {self.name!r} changes actions along cues, but the {self.spaces.actions.name} have no order: "
                "give them one (`Choices(count, order)`), or guidance demonstration, scalar or preference"
            )
        if self.options is None and self.config is not None:
            object.__setattr__(self, "options", self.config())

    @cached_property
    def network(self) -> GuideModel:
        """The network, or ensemble, of situations and actions."""
        return guide_model(self.sizes, self.spaces, self.outputs)

    def target(self, label: Label, scalars: GuideScalars) -> Float[Array, " outputs"]:
        """Return what the network is to predict for one label; here the answer."""
        return label.answer

    def predict(self, env: Any, params: Params, obs: Observations, actions: Actions) -> Float[Array, "n outputs"]:
        """Return the predictions that are fitted to the targets."""
        return self.network.predict(env, params, obs, actions)

    def act(
        self, model: GuidanceModel, env: Any, obs: Observations, actions: Actions, active: Rows, scalars: GuideScalars
    ) -> Refinement:
        """Return the actions to execute in place of a batch of actions.

        Rows that are not active do not change. Without a fitted model no row changes, if the guide asks for labels.
        """
        raise NotImplementedError(f"{type(self).__name__} does not say how it acts: write `act`")

    def init(self, key: PRNGKeyArray) -> GuidanceModel:
        """Return an unfitted model."""
        return GuidanceModel(self.network.init(key), jnp.array(False))

    def examples(self, labels: Label, scalars: GuideScalars) -> Any:
        """Return labels (slots, ...) with their targets; a label that names no cue is not valid.

        A cue that no label names counts in all of them, as no change: its output would keep its random start.
        """
        targets = jax.vmap(lambda label: self.target(label, scalars))(labels)
        # Rounded here: fused with later operations, the targets' last bits would depend on the compiler.
        space = self.spaces.actions if self.outputs is None else None
        rows = Example(labels.obs, labels.action, jax.lax.optimization_barrier(targets), labels.valid, space=space)
        if self.form is None or not self.form.by_eps or len(self.spaces.actions.cues) == 1:
            return rows
        cues = is_answered(labels.answer)
        valid = labels.valid & cues.any(-1)
        return rows.replace(valid=valid, cues=cues | silent_cues(labels.answer, valid, self.holds_out))

    def augmented(self, key: PRNGKeyArray, batch: Any) -> Any:
        """Return the batch to train on in place of a batch (n, ...) of examples."""
        return batch

    def fit(
        self, key: PRNGKeyArray, env: Any, labels: Label, former: GuidanceModel, scalars: GuideScalars
    ) -> GuidanceModel:
        """Return the model of labels (slots, ...); fitting from scratch ignores `former`, the previous model.

        Examples are never augmented by an environment's symmetries. Where several actions are equally good, a teacher's
        answer in the mirror image is mostly not the mirror image of its answer.
        """
        rows, losses, init = self.examples(labels, scalars), partial(self.losses, env, scalars), self.network.init
        return fit_model(key, rows, scalars, init=init, losses=losses, sizes=self.sizes, augment=self.augmented)

    def losses(self, env: Any, scalars: GuideScalars, params: Params, rows: Any) -> Float[Array, " n"]:
        """Return the loss of each row (n, ...) that `examples` gives."""
        return squared_errors(rows, self.predict(env, params, rows.obs, rows.action))

    def question(
        self, key: PRNGKeyArray, model: GuidanceModel, env: Any, obs: Observation, base: Action, scalars: GuideScalars
    ) -> Action:
        """Return the action to ask about: refined from `base` in a share `refined_fraction` of questions, else `base`.

        Source: DAgger (Ross, Gordon, Bagnell, 2011): what is asked about follows what will be met.
        """
        refines = jax.random.bernoulli(key, scalars.refined_fraction)
        return self.act(model, env, obs[None], base[None], refines[None], scalars).actions[0]

    def disagreement(self, model: GuidanceModel, env: Any, obs: Observations, actions: Actions) -> Float[Array, " n"]:
        """Return the variance of an ensemble's members, summed over their outputs."""
        less = self.spaces.actions.spread(REFERENCES) if self.compares else None
        return self.network.disagreement(env, model.params, obs, actions, less)

    def act_within(
        self,
        bound: Float[Array, ""],
        model: GuidanceModel,
        env: Any,
        obs: Observations,
        actions: Actions,
        active: Rows,
        scalars: GuideScalars,
    ) -> Refinement:
        """Return `act`, limited to within `bound` of the given actions for every kind."""
        space = self.spaces.actions
        refinement = self.act(model, env, obs, actions, active, bound_scalars(space, scalars, bound))
        return refinement._replace(actions=space.clip(refinement.actions, actions, bound))

    def in_question(self, actions: Actions, after: Actions) -> Actions:
        """Return actions after a correction; entries that nobody is asked about are as before."""
        asks, by_eps = [cue.is_asked for cue in self.spaces.actions.cues], self.form is not None and self.form.by_eps
        return after if all(asks) or not by_eps else jnp.where(jnp.array(asks)[None], after, actions)

    def refined(
        self,
        residual: Callable[[Actions], Actions],
        actions: Actions,
        active: Rows,
        scalars: GuideScalars,
        k_max: Int[Array, ""] | int | None = None,
    ) -> Refinement:
        """Return `refine` of the entries in question, within the scalars' limits; `k_max`: other passes at most."""
        space = self.spaces.actions
        limits = {"tau": space.from_unit(scalars.tau_deg), "tau_max": space.from_unit(scalars.tau_max_deg)}
        change = lambda current: self.in_question(jnp.zeros_like(current), residual(current))  # noqa: E731
        return refine(change, actions, active, space=space, **limits, k_max=scalars.k_max if k_max is None else k_max)


def replaced(others: Actions, actions: Actions, rows: Rows) -> Refinement:
    """Return the chosen actions in place of others in some rows, as one pass."""
    return Refinement(jnp.where(rows[:, None], others, actions), rows.astype(jnp.int32))


class NoGuide(Guide):
    """No guidance, the baseline of every other kind: a guide with an empty model, as other kinds without questions."""

    name, about, title, colour, moves = "none", "the agent alone", "no guidance", "#4d4d4d", False

    def init(self, key: PRNGKeyArray) -> GuidanceModel:
        """Return an empty model."""
        return GuidanceModel({}, jnp.array(False))

    def fit(
        self, key: PRNGKeyArray, env: Any, labels: Label, former: GuidanceModel, scalars: GuideScalars
    ) -> GuidanceModel:
        """Return the former model."""
        return former

    def act(
        self, model: GuidanceModel, env: Any, obs: Observations, actions: Actions, active: Rows, scalars: GuideScalars
    ) -> Refinement:
        """Return every action unchanged."""
        return no_refinement(actions)


class HeuristicGuide(NoGuide):
    """The environment's heuristic as a guide."""

    name, about, title, colour, moves = "heuristic", "the task's obvious action", "", "#D55E00", True
    needs = ("heuristic",)

    def act(
        self, model: GuidanceModel, env: Any, obs: Observations, actions: Actions, active: Rows, scalars: GuideScalars
    ) -> Refinement:
        """Return the heuristic's action in active rows."""
        return replaced(jax.vmap(env.heuristic)(obs), actions, active)


class AnyAim(NoGuide):
    """A guide that follows the nearest aim: what `intent` is before its first label."""

    name, about, title, colour, moves = "any_aim", "any of the task's aims, without a label", "", "#999933", True
    needs = ("aims",)

    def act(
        self, model: GuidanceModel, env: Any, obs: Observations, actions: Actions, active: Rows, scalars: GuideScalars
    ) -> Refinement:
        """Return the nearest of the aims that may be followed, in active rows; without any aim, the given action."""

        def one(obs: Array, action: Array) -> tuple[Array, Array]:
            aims = env.aims(obs)
            possible = aims.possible if aims.open is None else aims.possible & aims.open
            off = self.spaces.actions.distance(action[None], aims.actions)
            return aims.actions[jnp.argmin(jnp.where(possible, off, jnp.inf))], possible.any()

        goals, has_aim = jax.vmap(one)(obs, actions)
        return replaced(goals, actions, active & has_aim)


class ReadingGuide(NoGuide):
    """Answers as intervals for the right action, which say what changed in the world.

    No network is fitted and no action refined: `cuelearner_jax.reading` reads the answers, outside compiled programs.
    """

    name, about = "reading", "relative feedback for adaptation: what changed in the world, with an interval"
    title, colour, form, by_evidence = "", "#B15928", RELATIVE, True
