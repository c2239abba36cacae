"""Make a session's questions: a situation, an action in it, and what the page draws of them."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from cuelearner_jax import asking, user_code
from cuelearner_jax.asking import GuideState
from cuelearner_jax.environment import actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.labelling import controls
from cuelearner_jax.labelling.learner import Learner
from cuelearner_jax.labelling.plan import SAME, SessionPlan, keys_of, proceed
from cuelearner_jax.policies import policy_name
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.types import Reel, Sketch


class Item(NamedTuple):
    """A question: a situation and an action in it, or a pair of actions."""

    number: int  # from 0
    guide: GuideState  # the situation
    action: np.ndarray  # (action,)
    sketch: Sketch | None = None  # None: not needed yet
    refined: np.ndarray | None = None  # the action refined by the newest model; None: no model yet
    # drawings of the `controls.outcomes`, as `Pictures.trails`; None: not drawn yet
    trails: dict[str, str] | None = None
    second: np.ndarray | None = None  # the second action of a pair; None: not drawn yet, or no pair is asked about

    @property
    def pair(self) -> dict[str, np.ndarray]:
        """The two actions as the page shows them, A "left" and B "right"; empty where no pair is asked about.

        Questions with odd numbers show the second action as A, so that a habit of the person favours neither.
        """
        if self.second is None:
            return {}
        both = (self.second, self.action) if self.number % 2 else (self.action, self.second)
        return dict(zip(("left", "right"), both, strict=True))

    def in_form(self, answer: np.ndarray) -> np.ndarray:
        """Return an answer of the page's controls in the form's encoding, (width,)."""
        if self.second is None:
            return answer
        return np.concatenate([0.0 - answer if self.number % 2 else answer, self.second])


class Questions:
    """Makes items, and holds the model that later items are asked by."""

    def __init__(self, plan: SessionPlan, env: Any) -> None:
        self.plan, self.env, self.pictures, self.space = plan, env, plan.task.pictures(), actions_of(env)
        self.keys = keys_of(plan.seed)
        self.learner = Learner(plan, env, self.keys)

    def after(self, item: Item) -> GuideState:
        """Return the situation that follows an item's action."""
        keys = asking.question_keys(self.keys.session, item.number)
        return proceed(self.env, item.guide, jnp.asarray(item.action), keys)

    def ask(self, number: int, guide: GuideState) -> Item:
        """Choose the action to ask about in a situation. Raises UserError for invalid actions, or another situation."""
        if number < len(self.plan.again):
            obs, action = (np.asarray(self.plan.again[number][name], np.float32) for name in ("obs", "action"))
            if obs.shape != guide.obs.shape or not np.allclose(np.asarray(guide.obs), obs, atol=SAME):
                why = "the environment does not repeat itself, or a version of it or of cuelearner differs"
                raise UserError(f"question {number + 1} of --again had another situation: {why}: leave out --again")
            return Item(number, guide, action)
        action = self.learner.question(guide, asking.question_keys(self.keys.session, number))
        user_code.check_actions(np.isfinite(action), policy_name(self.plan.base.policy))
        return Item(number, guide, action)

    def draw(self, item: Item) -> Item:
        """Add what the page shows: the sketch, each answer's outcome, and the newest model's action."""
        if (draw := self.plan.form.second) is not None and item.second is None:
            key = asking.question_keys(self.keys.session, item.number).answer
            second = draw(key, self.space, jnp.asarray(item.action), self.plan.config.scalars)
            item = item._replace(second=np.asarray(second))
        if item.sketch is None:
            assert self.pictures.sketch is not None
            item = item._replace(sketch=self.pictures.sketch(self.env, item.guide.env))
        if item.trails is None:
            item = item._replace(trails=self._trails(item, self.outcomes(item)))
        return self.refine(item)

    def _trails(self, item: Item, actions: dict[str, np.ndarray]) -> dict[str, str]:
        """Return the task's drawings of where actions lead; empty where it draws none."""
        if self.pictures.trails is None:
            return {}
        drawings = self.pictures.trails(self.env, item.guide.env, jnp.asarray(np.stack([*actions.values()])))
        return {name: trail for name, trail in zip(actions, drawings, strict=True) if trail}

    def refine(self, item: Item) -> Item:
        """Add the newest model's action; a direction is drawn as an arrow, other actions as the task draws them."""
        if not self.learner.newest.number:
            return item._replace(refined=None)
        refined, trails = self.learner.refine(item.guide.obs, item.action), item.trails
        if trails and self.space != DIRECTIONS:
            trails = trails | self._trails(item, {"refined": refined})
        return item._replace(refined=refined, trails=trails)

    def outcomes(self, item: Item) -> dict[str, np.ndarray]:
        """Return each answer's outcome for an item's action, see `controls.outcomes`; of a pair its two actions."""
        return item.pair or controls.outcomes(self.plan.form, self.space, item.action, self.plan.config.scalars.eps_deg)

    def film(self, item: Item, action: np.ndarray) -> Reel | None:
        """Film the outcome of an action in an item's situation; None where the task has no films."""
        reel = self.pictures.reel
        return None if reel is None else reel(self.env, item.guide.env, jnp.asarray(action, jnp.float32))
