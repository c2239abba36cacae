"""The laws of tasks: kept by our own and by the probe, each broken by one altered task."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest
from brax import envs
from probes import CONFIG, Expert, Window, WindowConfig, make_task

from cuelearner_envs.billiards.config import BilliardsConfig
from cuelearner_envs.navigation.config import NavigationConfig
from cuelearner_jax.bridges.brax import from_brax
from cuelearner_jax.config import Scalars
from cuelearner_jax.environment import Quantity
from cuelearner_jax.task import Body, Pictures, Preset, Scenario
from cuelearner_jax.tasks.billiards import BILLIARDS
from cuelearner_jax.tasks.navigation import NAVIGATION
from cuelearner_jax.testing import check_environment, check_task

SMALL = WindowConfig()
PROBE = make_task()


class Wider(Window):
    """With one more entry in its observation."""

    observation = (Quantity("context", 2, "1"), Quantity("half the width", 1, "rad"))


class Counting(Window):
    """With an outcome of its episodes."""

    def step(self, key, state, action):
        after, step = super().step(key, state, action)
        return after, step.replace(outcome={"success": step.reward})


class Mistaken(Expert):
    """Answers no direction."""

    def best_action(self, state, obs):
        return 2.0 * super().best_action(state, obs)


class Halfhearted(Expert):
    """Holds something for good that is no direction."""

    def nearest_good(self, state, obs, action, spread, share):
        return 0.5 * action


class Field(envs.Env):
    """A walk in the plane: half the action is added to the place; ends past a length of 1."""

    observation_size = 2
    action_size = 2
    backend = "none"

    def reset(self, rng):
        return envs.State(None, 0.1 * jax.random.uniform(rng, (2,)), jnp.zeros(()), jnp.zeros(()))

    def step(self, state, action):
        place = state.obs + 0.5 * action
        return state.replace(obs=place, reward=place[0], done=(jnp.linalg.norm(place) > 1).astype(jnp.float32))


def with_preset(**changes):
    """The probe with one preset."""
    return dataclasses.replace(PROBE, presets={"small": Preset("seconds", CONFIG, **changes)})


def with_environment(make):
    """The probe with a preset and other environments."""
    return dataclasses.replace(with_preset(), bodies=(Body("point", "", make),))


def with_pictures(drawn):
    """The probe with a body that something draws."""
    return dataclasses.replace(PROBE, bodies=(dataclasses.replace(PROBE.bodies[0], pictures=lambda: drawn),))


def by_width(config, split):
    return Window() if config.half_width_deg > 10 else Wider()


def by_split(config, split):
    return Window(jnp.zeros(()) if split == "training" else jnp.zeros(2))


def written(*given):
    given[-1].write_bytes(b"a picture")


def recorded(env, policy, key, steps):
    return [None] * steps, [0.0] * steps


DRAWN = Pictures(recorded, written, written, written)
NARROW = {"narrow": Scenario("", {"half_width_deg": 5.0})}
FAST = dataclasses.replace(CONFIG, scalars=Scalars(discount=2.0))
BROKEN = {
    "a discount of 2": (
        dataclasses.replace(PROBE, presets={"fast": Preset("", FAST)}),
        "preset 'fast' fails (UserError: scalars.discount is 2.0",
    ),
    "nobody to ask": (
        dataclasses.replace(with_preset(guidance=("none", "relative")), teacher=None),
        "preset 'small' compares guidance ['relative'], which it cannot have",
    ),
    "a wider scenario": (
        dataclasses.replace(with_environment(by_width), scenarios=NARROW),
        "scenario 'narrow' has observations of 3 entries, not 2",
    ),
    "splits of other shapes": (with_environment(by_split), "environments of other shapes for other splits"),
    "episodes of no length": (
        with_environment(lambda config, split: Counting()),
        "its episodes have outcomes ['success'], but it does not say how long they last: fill `longest`",
    ),
    "short evaluations": (
        dataclasses.replace(with_preset(), longest=lambda config: 3),
        "schedule.eval-steps is 20 for 10 environments, 2 each, but an episode lasts up to 3",
    ),
    "no direction": (
        dataclasses.replace(PROBE, teacher=lambda config, env: Mistaken(env)),
        "its teacher's best action is not an action of the space",
    ),
    "no good direction": (
        dataclasses.replace(PROBE, teacher=lambda config, env: Halfhearted(env)),
        "its teacher's nearest good action is not an action of the space",
    ),
    "nothing draws it": (PROBE, "window has no pictures of point"),
    "nothing is written": (with_pictures(DRAWN._replace(still=lambda *_: None)), "window.png was not written"),
    "too few rewards": (with_pictures(DRAWN._replace(record=lambda *_: ([], [0.0]))), "returns 1 rewards of 3 steps"),
}


@pytest.mark.parametrize("law", BROKEN)
def test_a_broken_law_is_told_in_one_line(law, tmp_path):
    task, told = BROKEN[law]
    with pytest.raises(AssertionError) as raised:
        check_task(task, SMALL, pictures=tmp_path)
    assert told in str(raised.value)
    assert "\n" not in str(raised.value)


def test_the_probe_keeps_the_laws(tmp_path):
    check_task(with_preset(), SMALL)
    check_task(with_pictures(DRAWN), SMALL, pictures=tmp_path)
    with pytest.raises(AssertionError, match="give a WindowConfig"):
        check_task(PROBE, CONFIG)


@pytest.mark.long
def test_navigation_keeps_them():
    check_task(NAVIGATION, NavigationConfig(worlds=8, max_steps=12, mirrors=True), steps=24)


@pytest.mark.long
def test_billiards_keeps_them():
    check_task(BILLIARDS, BilliardsConfig(table="regulation", mirrors=True, search_directions=24), steps=12)


def test_a_task_of_brax_keeps_them():
    check_environment(from_brax(Field(), max_steps=3))
