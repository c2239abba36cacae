"""Every number of every task's configuration, held against what no world can be made of."""

import dataclasses
import math
import re

import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.tasks import registry

NEGATIVE = {
    "action_turn_deg",
    "observation_bias",
    "acceleration",
    "lidar_rotation_deg",
    "goal_rotation_deg",
    "camera_turn_deg",
    "camera_offset",
}  # where -1 makes sense
SENSELESS = (math.nan, -math.inf, 1e39, 10**400, "many", None, True)  # 1e39: infinite in single precision


def numeric(task):
    """(field, a valid value) of each that holds a number, or several."""
    for field in dataclasses.fields(task.config):
        value = getattr(task.config(), field.name)
        if isinstance(value, (int, float, tuple)) and not isinstance(value, bool):
            yield field.name, value


OWN = [name for name in registry.BUILT_IN if name not in registry.FAMILIES]  # tests/bridges/test_by_name.py has these
FIELDS = [(name, *field) for name in OWN for field in numeric(registry.find(name))]


@pytest.mark.parametrize(("task", "field", "valid"), FIELDS, ids=[f"{name}-{field}" for name, field, _ in FIELDS])
def test_a_number_that_makes_no_world_is_refused_in_one_line(task, field, valid):
    found = registry.find(task)
    for number in [*SENSELESS, *([] if field in NEGATIVE else [-1])]:
        values = [number] if not isinstance(valid, tuple) else [(number, 0.0), (0.0, number), (0.0,), number]
        for value in values:
            with pytest.raises(UserError, match=re.escape(f"task.{field} is ")) as refused:
                found.environment(found.config(**{field: value}))
            assert "\n" not in str(refused.value)
            assert ": give " in str(refused.value)
    if isinstance(valid, int):
        with pytest.raises(UserError, match="give a whole number"):
            found.environment(found.config(**{field: 1.5}))
