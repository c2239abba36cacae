"""Conformance checks: our own parts keep the laws, and one altered part breaks each of the laws that people break."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from probes import CONFIG, Aimed, Chain, Window, WindowConfig, long_but, make_task

from cuelearner_jax.environment import Features, Quantity
from cuelearner_jax.guides import registry
from cuelearner_jax.guides.refining import Refinement
from cuelearner_jax.guides.relative import Relative
from cuelearner_jax.policies import SHARED, Opaque, Uniform
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.spaces.directions import retract, rotate
from cuelearner_jax.task import Body, Pictures, Preset, Scenario
from cuelearner_jax.tasks.billiards import BILLIARDS
from cuelearner_jax.tasks.navigation import NAVIGATION
from cuelearner_jax.testing import check_environment, check_guidance, check_policy, check_task
from cuelearner_jax.testing.guidances import SMALL

SIZES = dataclasses.replace(SMALL, feedback_layers=(4,), fit_steps=2, validate_every=2)


def breaks(check, message, *arguments, **options):
    """The check fails with one line that holds the message."""
    with pytest.raises(AssertionError) as error:
        check(*arguments, **options)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


# Environments.


def other(base=Window, **members):
    """The bandit, or another probe, with other members."""
    return type("Other", (base,), {"__module__": __name__, **members})()


def stepping(change, base=Window):
    """A probe whose step is changed: (state before, state after, step) -> (state, step)."""

    def step(self, key, state, action):
        return change(state, *base.step(self, key, state, action))

    return other(base, step=step)


class Outside(Window):
    def reset(self, key):
        state, obs = super().reset(key)
        return state, obs * np.random.default_rng().uniform()


def mirrored(image):
    """The bandit with another `mirror`."""
    return other(symmetries=2, mirror=lambda self, *given: image(*given))


ENVIRONMENTS = {
    "sizes": (other(observation=(Quantity("a", 3, "1"),)), "observation is float32 of shape (2,): make it"),
    "a column": (
        stepping(lambda state, after, step: (after, step.replace(outcome={"failed": step.reward}))),
        "metrics or outcomes are called ['failed'], as other columns of results",
    ),
    "random numbers": (Outside(), "draw all random numbers from the key alone"),
    "no end": (
        stepping(lambda state, after, step: (state, step.replace(obs=state, terminated=jnp.array(False)))),
        "no episode ends within 64 steps",
    ),
    "no reset": (
        stepping(lambda state, after, step: (state, step.replace(obs=step.final_obs))),
        "Step.obs is Step.final_obs wherever an episode ends",
    ),
    "recall": (other(recall=lambda self, memory: -memory), "recall(remember(state, obs)) is not obs"),
    "recall_next": (
        other(recall_next=lambda self, memory, action, aftermath: memory + aftermath),
        "recall_next(remember(state, obs), action, aftermath) is not Step.final_obs",
    ),
    "privileged": (other(privileged=2), "`privileged` numbers are missing: append them"),
    "own features": (
        other(features=lambda self, obs, action: Features(action.ravel()[:1], action)),
        "`features` hold values in `own` that depend on the action",
    ),
    "no group": (mirrored(lambda which, *both: tuple(rotate(v, which * 1.0) for v in both)), "no symmetry undoes"),
}


@pytest.mark.parametrize("law", long_but(("sizes", "a column", "random numbers", "no reset", "recall"), ENVIRONMENTS))
def test_a_broken_law_of_environments_is_found(law):
    env, message = ENVIRONMENTS[law]
    breaks(check_environment, message, env)


@pytest.mark.parametrize("env", [Aimed(), Window(jnp.float32(0.3), mirrors=True), Chain(jnp.array(True))], ids=str)
def test_the_probes_keep_the_laws(env):
    check_environment(env)


# Guidances.


def guide(**changes):
    """The paper's kind with other methods, each made from the one that is there: (method) -> method."""
    return type("Altered", (Relative,), {name: change(getattr(Relative, name)) for name, change in changes.items()})


def result(change):
    """A method whose result is changed."""
    return lambda method: lambda *given: change(method(*given))


def unfitted_too(act):
    def guided(self, model, env, obs, actions, active, scalars):
        return Refinement(jnp.where(active[:, None], -actions, actions), active.astype(jnp.int32))

    return guided


GUIDANCES = {
    "a flat target": (guide(target=result(lambda target: target.sum())), "`target` of one label has shape ()"),
    "no fit": (
        guide(fit=result(lambda model: model.replace(fitted=jnp.array(False)))),
        "`fit` of valid labels returns an unfitted model",
    ),
    "an unfitted guide": (guide(act=unfitted_too), "`act` of an unfitted model changes actions"),
}


@pytest.mark.parametrize("law", long_but(("a flat target", "an unfitted guide"), GUIDANCES))
def test_a_broken_law_of_guidance_is_found(law):
    kind, message = GUIDANCES[law]
    breaks(check_guidance, message, kind, Window(), SIZES)


@pytest.mark.parametrize(
    "name",
    long_but(("none", "relative", "preference"), [kind.name for kind in registry.BUILT_IN if not kind.by_evidence]),
)
def test_our_own_kinds_keep_the_laws(name):
    check_guidance(registry.find(name), Aimed(mirrors=True), SIZES)


def test_what_a_kind_needs_must_be_there():
    breaks(check_guidance, "it needs a heuristic", registry.find("heuristic"), other(heuristic=None), SIZES)


# Policies.


class Turned(struct.PyTreeNode):
    """The observation as an action, turned upside down by a parameter; `change`: what is made of that action."""

    sign: float = -1.0
    change: object = struct.field(pytree_node=False, default=lambda key, actions: actions)

    def act(self, key, states, obs):
        return self.change(key, retract(self.sign * obs))

    @property
    def axes(self):
        return self.replace(sign=SHARED)


def hidden_noise(key, actions):
    shape = jax.ShapeDtypeStruct(actions.shape, jnp.float32)
    drawn = jax.pure_callback(lambda: np.random.default_rng().normal(size=actions.shape).astype(np.float32), shape)
    return retract(actions + drawn)


POLICIES = {
    "a length": (Turned(change=lambda key, actions: 2.0 * actions), "is not an action of the space"),
    "neighbours": (Turned(change=lambda key, actions: retract(actions + actions[:1])), "depends on the others"),
    "hidden noise": (Turned(change=hidden_noise), "the same key gives other actions"),
}


@pytest.mark.parametrize("law", POLICIES)
def test_a_broken_law_of_policies_is_found(law):
    policy, message = POLICIES[law]
    breaks(check_policy, message, policy, Window())


OWN = {
    "chance": Uniform(),
    "a function on the host": Opaque(np.negative, on_host=True),
    "drawn actions": Turned(change=lambda key, actions: DIRECTIONS.sample(key, (len(actions),))),
}


@pytest.mark.parametrize("name", OWN)
def test_policies_keep_the_laws(name):
    check_policy(OWN[name], Window())


# Tasks.

PROBE = make_task()


class Wider(Window):
    """With one more entry in its observation."""

    observation = (Quantity("context", 2, "1"), Quantity("half the width", 1, "rad"))


def with_pictures(drawn):
    """The probe with a body that something draws."""
    return dataclasses.replace(PROBE, bodies=(dataclasses.replace(PROBE.bodies[0], pictures=lambda: drawn),))


def write(*given):
    given[-1].write_bytes(b"a picture")


DRAWN = Pictures(lambda env, policy, key, steps: ([None] * steps, [0.0] * steps), write, write, write)
BY_WIDTH = Body("point", "", lambda config, split: Window() if config.half_width_deg > 10 else Wider())
PRESETS = {"small": Preset("seconds", CONFIG)}
NARROW = {"narrow": Scenario("", {"half_width_deg": 5.0})}
TASKS = {
    "a wider scenario": (
        dataclasses.replace(PROBE, bodies=(BY_WIDTH,), presets=PRESETS, scenarios=NARROW),
        "scenario 'narrow' has observations of 3 entries, not 2",
    ),
    "nothing is written": (with_pictures(DRAWN._replace(still=lambda *_: None)), "window.png was not written"),
}


@pytest.mark.parametrize("law", TASKS)
def test_a_broken_law_of_tasks_is_found(law, tmp_path):
    task, message = TASKS[law]
    breaks(check_task, message, task, WindowConfig(), pictures=tmp_path)


def test_the_probe_task_keeps_the_laws(tmp_path):
    check_task(with_pictures(DRAWN), WindowConfig(), pictures=tmp_path)


@pytest.mark.long
@pytest.mark.parametrize(
    ("task", "small"),
    [
        (NAVIGATION, {"worlds": 8, "max_steps": 12, "mirrors": True, "keep_scans": True}),
        (NAVIGATION, {"worlds": 2, "max_steps": 12}),
        (BILLIARDS, {"table": "regulation", "mirrors": True, "search_directions": 24}),
    ],
    ids=["navigation", "scans again", "billiards"],
)
def test_shipped_tasks_keep_the_laws(task, small):
    check_task(task, task.config(**small), steps=24)
