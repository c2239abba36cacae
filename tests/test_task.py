"""What a task refuses to be, and how its bodies, scenarios and teacher are chosen."""

import dataclasses
import re

import jax
import probes
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.task import Body, Preset, Scenario

PRESET = Preset("small", probes.CONFIG)
TASK = dataclasses.replace(
    probes.make_task(), presets={"small": PRESET}, scenarios={"narrow": Scenario("hard", {"half_width_deg": 5.0}, 20.0)}
)


def wide(config, split):
    """Twice as easy."""
    return probes.Window(jax.numpy.deg2rad(2 * config.half_width_deg))


WIDE = Body("wide", "twice as easy", wide, {"abacus": lambda *arguments: {"reward": 1.0}})
TWO = dataclasses.replace(TASK, bodies=(*TASK.bodies, WIDE))


CANNOT_BE = [
    ({"name": "my task"}, "task 'my task': its name must be an identifier"),
    ({"bodies": (WIDE, WIDE)}, "each body needs another name, not ['wide', 'wide']"),
    ({"scenarios": {"x": Scenario("", {"half_with_deg": 1.0})}}, "unexpected keyword argument 'half_with_deg'"),
    ({"scenarios": {"x": Scenario("", {}, sizes={"members": 5})}}, "unexpected keyword argument 'members'"),
]


@pytest.mark.parametrize(("changes", "says"), CANNOT_BE, ids=[says for _, says in CANNOT_BE])
def test_parts_that_do_not_fit_together_are_refused_at_once(changes, says):
    with pytest.raises(ValueError, match=re.escape(says)):
        dataclasses.replace(TASK, **changes)


def test_a_body_takes_the_first_place_and_keeps_all_else():
    changed = TWO.on("wide")
    assert [body.name for body in changed.bodies] == ["wide", "point"]
    assert float(changed.environment(probes.WindowConfig(10.0)).half_width) == pytest.approx(0.349, abs=1e-3)
    assert float(TWO.environment(probes.WindowConfig(10.0)).half_width) == pytest.approx(0.1745, abs=1e-3)
    assert TWO.on(None) is TWO
    assert changed.on("point") == TWO
    assert changed.presets == TWO.presets
    assert (TWO.robot, changed.robot) == ("", "wide")


def test_bodies_and_engines_that_are_not_there_are_refused():
    with pytest.raises(UserError, match="unknown robot 'wid', did you mean 'wide'"):
        TWO.on("wid")
    with pytest.raises(UserError, match="window has no robots to choose from: leave out --robot"):
        TASK.on("wide")
    assert TWO.engine(None) is None
    assert TWO.on("wide").engine("abacus") is WIDE.engines["abacus"]
    with pytest.raises(UserError, match="--engine abacus needs --robot: choose one of wide"):
        TWO.engine("abacus")
    with pytest.raises(UserError, match="unknown engine 'abakus', did you mean 'abacus'"):
        TWO.on("wide").engine("abakus")
    with pytest.raises(UserError, match="window has no pictures of point"):
        TWO.pictures()


def test_a_scenario_changes_its_fields_alone():
    assert TASK.scenario("narrow").apply(probes.WindowConfig(28.0)) == probes.WindowConfig(5.0)
    with pytest.raises(UserError, match="unknown scenario 'narow', did you mean 'narrow'"):
        TASK.scenario("narow")
    with pytest.raises(UserError, match="window has no scenarios"):
        probes.make_task().scenario("narrow")
