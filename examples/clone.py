"""A guidance of one's own in one file: the teacher names a point of the compass, a network of these acts in its place.

Run in the folder above this one, with any task that has a teacher:

    cuelearner sweep examples.reach:TASK --guidance none examples.clone:KIND --out runs/clone
    cuelearner report runs/clone --out runs/clone/report --metric success
    cuelearner evaluate runs/clone --task examples.reach:TASK --guidance none examples.clone:KIND --policy guide
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.actions import evenly_spaced, rotate
from cuelearner_jax.agents.networks import applied, residual_network
from cuelearner_jax.config import GuideScalars, GuideSizes, Scalars
from cuelearner_jax.environment import Spaces
from cuelearner_jax.feedback.forms import AnswerForm
from cuelearner_jax.guides.bundle import Guidance
from cuelearner_jax.guides.fitting import fit_least_squares, lessons
from cuelearner_jax.guides.kind import Kind
from cuelearner_jax.guides.questions import about_refined
from cuelearner_jax.guides.refining import Refined
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

    Of the faults in `scalars` it has those that mean something here: its bias and its silence.
    """
    best = rotate(teacher.best_action(state, obs), scalars.radians("teacher_bias"))
    return jnp.argmax(evenly_spaced(POINTS) @ best)[None] * 1.0, ~jax.random.bernoulli(key, scalars.silence_probability)


FORM = AnswerForm(
    name="compass",
    width=1,
    meaning="number of the point of the compass, of eight, counterclockwise from the x axis",
    answer=named,
    values=tuple(float(point) for point in range(POINTS)),
)


def make(sizes: GuideSizes, spaces: Spaces) -> Guidance:
    """The bundle for an environment's spaces."""
    space = spaces.actions
    network = residual_network(sizes.feedback_layers, space.size)

    def init_params(key: PRNGKeyArray) -> Params:
        return network.init(key, jnp.zeros(spaces.obs_size), jnp.zeros(space.size))

    def predict(params: Params, obs: Array, actions: Array) -> Array:
        """The network's action, whatever the action asked about was."""
        return applied(network)(params, obs, jnp.zeros_like(actions))

    def init(key: PRNGKeyArray) -> GuidanceModel:
        return GuidanceModel(init_params(key), jnp.array(False))

    def target(label: Label, scalars: GuideScalars) -> Float[Array, "2"]:
        """The direction of the point that was named."""
        return evenly_spaced(POINTS)[label.answer[0].astype(int)]

    def fit(key: PRNGKeyArray, env: Any, labels: Label, former: GuidanceModel, scalars: GuideScalars) -> GuidanceModel:
        rows = lessons(labels, target, scalars)
        return fit_least_squares(key, rows, scalars, init=init_params, apply=predict, sizes=sizes)

    def act(
        model: GuidanceModel, env: Any, obs: Array, actions: Array, active: Array, scalars: GuideScalars
    ) -> Refined:
        """The network's actions in active rows, once it has been fitted."""
        guided = active & model.fitted
        chosen = space.retract(predict(model.params, obs, actions))
        return Refined(jnp.where(guided[:, None], chosen, actions), guided.astype(jnp.int32))

    # Questions are about the model's own choices: the situations that follow are those that it will meet.
    return Guidance("clone", FORM, init, about_refined(act), target, fit, act)


KIND = Kind("clone", "a network of the points that the teacher names", make, form=FORM, colour="#CC79A7")
