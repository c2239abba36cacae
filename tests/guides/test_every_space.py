"""Every kind in boxes of 1, 3 and 7 entries and in ordered choices, where a policy misses its goal by a constant.

Teachers speak of all cues, of the worst one or of one at random: a cue of which nothing is said teaches nothing.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_jax.adaptation import by_model
from cuelearner_jax.config import GuideSizes
from cuelearner_jax.environment import Quantity, Spaces, WholeObservations
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback.answers import human_answer
from cuelearner_jax.guides import registry
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.guides.fitting import squared_errors
from cuelearner_jax.guides.relative import Relative
from cuelearner_jax.spaces import UNSAID, Box, Choices, Cue
from cuelearner_jax.types import Label

GEARS = Choices(9, Cue("gear", ("higher", "lower"), ("PageUp", "PageDown"), "steps"))
FRUIT = Choices(3)
SPACES = {
    "1": Box((-2.0,), (2.0,)),
    "3": Box((-1.0, 0.0, -2.0), (1.0, 4.0, 0.0)),
    "7": Box((-1.0,) * 7, tuple(1.0 + 0.5 * entry for entry in range(7))),
    "gears": GEARS,
}
SIZES = GuideSizes(feedback_layers=(32, 32), fit_steps=300, fit_batch_size=32)
KEY = jax.random.key(5)
COUNT = 64


class Anywhere(WholeObservations):
    """Observations of two entries; nothing else is asked of a world where labels are given."""

    observation = (Quantity("context", 2, "1"),)

    def __init__(self, space):
        self.actions = space


def goal(space, obs):
    """Where the teacher wants actions: the middle, or a little away from it by what is seen."""
    change = 2.0 * jnp.sign(obs[0]) if space.grain else jnp.resize(0.1 * obs, len(space.cues))
    middle = jnp.eye(space.size)[space.size // 2] if space.grain else space.spread(1)[0]
    return space.exp(middle, jnp.broadcast_to(change, (len(space.cues),)))


def missing(space, obs):
    """What the policy does: two steps, or a fifth of each range, to one side of the goal or the other."""
    sides = jnp.where(jnp.arange(len(space.cues)) % 2, -1.0, 1.0)
    return space.exp(goal(space, obs), sides * (2.0 if space.grain else 0.2))


def scalars_of(space, **faults):
    eps = 1.0 if space.grain else 0.08
    plain = dataclasses.replace(
        by_model.plain_scalars(space), feedback_learning_rate=1e-2, max_grad_norm=10.0, k_max=20
    )
    most = 4.0 if space.grain else 0.4  # as far as the labels reach
    return dataclasses.replace(plain, eps_deg=eps, tau_deg=eps / 20, tau_max_deg=most, **faults)


@partial(jax.jit, static_argnums=(0, 2, 3))
def told(space, scalars, form, count):
    """Labels about actions that lie uniformly round the policy's own, with the answers of a teacher of the goal."""
    k_obs, k_turn, k_say = jax.random.split(KEY, 3)
    obs = jax.random.uniform(k_obs, (count, 2), minval=-1.0)
    base = jax.vmap(partial(missing, space))(obs)
    most = 4.0 if space.grain else 0.4
    action = space.exp(base, jax.random.uniform(k_turn, (count, len(space.cues)), minval=-most, maxval=most))
    best = jax.vmap(partial(goal, space))(obs)
    say = jax.vmap(lambda key, action, best: human_answer(key, space, action, best, scalars))
    answer, answered = say(jax.random.split(k_say, count), action, best)
    if form == "demonstration":
        answer, answered = best, jnp.ones(count, bool)
    if form == "scalar":
        within = 0.5 if space.grain else 0.08
        answer, answered = (space.distance(action, best) <= within)[:, None] * 1.0, jnp.ones(count, bool)
    return Label(obs, action, answer, answered, base)


def left(kind, name, labels=200, **faults):
    """Mean distance from the goal of what a guide makes of the policy's actions, as a share of the policy's own."""
    space = SPACES[name]
    env, scalars = Anywhere(space), scalars_of(space, **faults)
    guide = registry.make(kind, SIZES, env)
    rows = told(space, scalars, guide.form.name, labels)
    model = jax.jit(lambda rows: guide.fit(KEY, env, rows, guide.init(KEY), scalars))(rows)
    obs = jax.random.uniform(jax.random.key(77), (COUNT, 2), minval=-1.0)
    first, goals = (jax.jit(jax.vmap(partial(which, space)))(obs) for which in (missing, goal))
    acted = jax.jit(lambda: guide.act(model, env, obs, first, jnp.ones(COUNT, bool), scalars).actions)()
    np.testing.assert_allclose(jax.jit(space.retract)(acted), acted, atol=1e-5)
    within = dataclasses.replace(scalars, tau_max_deg=0.5 * scalars.eps_deg if not space.grain else 1.0)
    log = jax.jit(space.log)
    near = jax.jit(lambda: guide.act(model, env, obs[:4], first[:4], jnp.ones(4, bool), within).actions)()
    if kind != "scalar":
        assert np.abs(log(first[:4], near)).max() <= within.tau_max_deg + 1e-5  # tau_max holds along every cue
    away = lambda actions: float(np.abs(log(actions, goals)).mean())  # noqa: E731
    return away(acted) / away(first)


def long(*values):
    return pytest.param(*values, marks=pytest.mark.long)


PEERS = (("1", "all", 0.7), ("3", "one", 0.9), ("7", "all", 0.9), ("gears", "all", 0.7))


@pytest.mark.parametrize(
    ("kind", "space", "says", "most"),
    [
        ("relative", "3", "one", 0.4),
        ("relative", "gears", "all", 0.1),
        *(long("relative", *case) for case in (("1", "all", 0.2), ("7", "all", 0.3))),
        *(long("dcoach", *case) for case in (("1", "all", 0.9), ("7", "all", 0.9), ("gears", "all", 0.8))),
        *(long("demonstration", space, "all", 0.1) for space in ("1", "7", "gears")),
        *(long(kind, *case) for kind in ("bdcoach", "clic", "clic_shown") for case in PEERS),
        long("scalar", "gears", "all", 0.6),
    ],
)
def test_a_kind_leads_a_policy_that_misses_toward_its_goal(kind, space, says, most):
    assert left(kind, space, says=says) < most


# The last two turn on the last bits, so their units are powers of two.
OTHER, POWERS = (Box((5.0, -1e-3), (10.0, 1e-3)), 1e3, 3e4), (Box((-4.0, -(2**-9)), (4.0, 2**-9)), 2.0**10, 0.0)


@pytest.mark.parametrize(
    ("kind", "units"),
    [("relative", OTHER), long("demonstration", OTHER), long("bdcoach", POWERS), long("clic", POWERS)],
)
def test_a_kind_learns_alike_in_any_units(kind, units):
    plain, scalars = Box((-1.0,) * 2, (1.0,) * 2), scalars_of(SPACES["1"])

    def shares(space, unit, zero):
        """What a guide changes [ranges] where actions lie in a box, and observations have this unit and zero."""
        guide = registry.make(kind, SIZES, Anywhere(space))
        into = lambda actions: space.exp(space.middle(), plain.log(plain.middle(), actions))  # noqa: E731
        rows = told(plain, scalars, guide.form.name, 100)
        answer = into(rows.answer) if guide.form.is_action else rows.answer
        rows = rows.replace(obs=zero + unit * rows.obs, action=into(rows.action), answer=answer, base=into(rows.base))
        model = guide.fit(KEY, guide, rows, guide.init(KEY), scalars)
        return space.log(rows.base, guide.act(model, guide, rows.obs, rows.base, jnp.ones(100, bool), scalars).actions)

    ours = jax.jit(partial(shares, plain, 1.0, 0.0))()
    theirs = jax.jit(partial(shares, *units))()
    assert np.abs(ours).mean() > 0.05
    np.testing.assert_allclose(ours, theirs, atol=0.02)


def test_a_cue_of_which_nothing_is_said_adds_nothing_to_the_loss():
    """Ranges 2, 4, 2: errors of 0.2 and 0.4 of said entries are 0.1 of the range each; the other one does not count."""
    space = SPACES["3"]
    obs, action = jnp.zeros((2, 2)), jnp.tile(space.spread(1), (2, 1))
    labels = Label(obs, action, jnp.array([[1.0, UNSAID, 0.0], [UNSAID, -1.0, UNSAID]]), jnp.ones(2, bool))
    scalars = scalars_of(space)
    guide = Relative(SIZES, Spaces(2, space))
    rows = jax.jit(lambda labels: Guide.examples(guide, labels, scalars))(labels)
    eps = scalars.eps_deg
    np.testing.assert_allclose(rows.target, [[2 * eps, 0, 0], [0, -4 * eps, 0]], atol=1e-6)
    off = jnp.array([[0.2, 77.0, 0.0], [-5.0, 0.4, 3.0]])
    errors = lambda predicted: (squared_errors(rows, predicted).sum(), squared_errors(rows, predicted))  # noqa: E731
    gradient, found = jax.jit(jax.grad(errors, has_aux=True))(rows.target + off)
    np.testing.assert_allclose(found, [0.1**2, 0.1**2], rtol=1e-3)
    np.testing.assert_array_equal(gradient == 0, [[False, True, True], [True, False, True]])
    np.testing.assert_allclose(gradient[0, 0], 2 * 0.2 / 2**2, rtol=1e-3)  # d/dx (x / range)^2


@pytest.mark.parametrize("kind", ["relative", "clic", "reading"])
def test_a_kind_of_cues_refuses_choices_without_an_order_in_one_line(kind):
    with pytest.raises(UserError, match="have no order: give them one") as refusal:
        registry.make(kind, SIZES, Anywhere(FRUIT))
    assert "\n" not in str(refusal.value)
    assert kind not in registry.possible(Anywhere(FRUIT), taught=True)
    assert {"demonstration", "scalar", "none"} <= set(registry.possible(Anywhere(FRUIT), taught=True))
