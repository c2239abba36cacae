"""A guidance of one's own in one file: the teacher names a point of the compass, a network of these acts in its place.

Run in the folder above this one, with any task that has a teacher:

    cuelearner sweep examples.reach:TASK --guidance none examples.clone:Clone --clone.way 0.9 --out runs/clone
    cuelearner report runs/clone --out runs/clone/report --metric success
    cuelearner evaluate runs/clone --task examples.reach:TASK --guidance none examples.clone:Clone --policy guide
"""

from __future__ import annotations

from typing import Annotated, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.config import Bounds, GuideScalars, Scalars, part
from cuelearner_jax.feedback.answers import AnswerForm
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.guides.refining import Refinement
from cuelearner_jax.spaces.directions import evenly_spaced, rotate
from cuelearner_jax.types import EnvState, GuidanceModel, Label, Params, Teacher

POINTS = 8  # of the compass, counterclockwise from the x axis


def named(
    key: PRNGKeyArray,
    env: Any,
    teacher: Teacher,
    state: EnvState,
    obs: Float[Array, " obs"],
    action: Float[Array, " action"],
    scalars: Scalars,
) -> tuple[Float[Array, "1"], Bool[Array, ""]]:
    """The number of the point nearest to the best action of a teacher, and whether it answered.

    It has the faults in `scalars` that mean something here: a bias, mistakes, which are the opposite, and silence.
    """
    best = rotate(teacher.best_action(state, obs), jnp.deg2rad(scalars.teacher_bias_deg))
    mistaken = jax.random.bernoulli(jax.random.fold_in(key, 1), scalars.mistake_probability)
    best = jnp.where(mistaken, -best, best)
    return jnp.argmax(evenly_spaced(POINTS) @ best)[None] * 1.0, ~jax.random.bernoulli(key, scalars.silence_probability)


FORM = AnswerForm(
    name="compass",
    width=lambda space: 1,
    meaning=lambda space: "number of the point of the compass, of eight, counterclockwise from the x axis",
    answer=named,
    values=lambda space: tuple(map(float, range(POINTS))),
)


@part
class Config:
    """Options that this kind alone has: `--clone.way 0.5`."""

    way: Annotated[float, Bounds(0, 1, above=True)] = 1.0
    """Share of the way to the network's action that is gone."""


class Clone(Guide):
    """A network of the points that the teacher names, which acts in the agent's place.

    What is not written here is the base class's: the network, its fit by least squares, and questions about what the
    network would do, so that the situations which follow are those that it will meet.
    """

    name, about = "clone", "a network of the points that the teacher names"
    form, colour, config = FORM, "#CC79A7", Config

    def target(self, label: Label, scalars: GuideScalars) -> Float[Array, "2"]:
        """The direction of the point that was named."""
        return evenly_spaced(POINTS)[label.answer[0].astype(int)]

    def predict(self, env: Any, params: Params, obs: Array, actions: Array) -> Array:
        """The network's action, whatever the action asked about was."""
        return self.network.predict(env, params, obs, jnp.zeros_like(actions))

    def act(
        self, model: GuidanceModel, env: Any, obs: Array, actions: Array, active: Array, scalars: GuideScalars
    ) -> Refinement:
        """The network's actions in active rows, once it has been fitted."""

        def way(current: Array) -> Array:
            return self.options.way * (self.predict(env, model.params, obs, current) - current)

        return self.refined(way, actions, active & model.fitted, scalars, k_max=1)
