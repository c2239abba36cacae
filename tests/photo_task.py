"""The bandit with actions of a box as a task whose situations are pictures: a gripper that one sees."""

import dataclasses

import box_task
import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageDraw

from cuelearner_jax import pictures
from cuelearner_jax.task import Body, Pictures
from cuelearner_jax.types import Sketch

SIZE = 240  # pixels


def photo(state, action=None):
    """A table with a gripper in the middle and a cup where the context is; after an action the gripper has moved."""
    image = Image.new("RGB", (SIZE, SIZE), (208, 200, 186))
    draw = ImageDraw.Draw(image)
    draw.rectangle((0, SIZE * 0.7, SIZE, SIZE), fill=(140, 108, 80))
    x, y = (SIZE * (0.5 + 0.25 * float(part)) for part in (state[0], -state[1]))
    draw.ellipse((x - 14, y - 14, x + 14, y + 14), fill=(200, 60, 40))
    moved = np.zeros(3) if action is None else np.asarray(box_task.GRIPPER.log(box_task.GRIPPER.middle(), action))
    at, open_by = (SIZE * (0.5 - 0.3 * moved[0]), SIZE * (0.5 - 0.3 * moved[1])), 14 + 20 * moved[2]
    for inner in (at[0] - open_by - 8, at[0] + open_by):
        draw.rectangle((inner, at[1] - 26, inner + 8, at[1] + 26), fill=(60, 70, 90))
    draw.line((at[0], 0, at[0], at[1] - 20), fill=(60, 70, 90), width=10)
    return np.asarray(image)


def _sketch(env, state) -> Sketch:
    return pictures.sketch(photo(state), "a gripper above a table, and a cup")


def _reel(env, state, action):
    middle, action = env.actions.middle(), jnp.asarray(action)
    way = [middle + (action - middle) * share for share in np.linspace(0, 1, 6)]
    apart = float(env.actions.distance(env.best(state), action))
    return pictures.clip([photo(state, part) for part in way], 0.1, f"{apart:.2f} from the best")


PICTURES = Pictures(None, None, None, None, _sketch, _reel)  # pyright: ignore[reportArgumentType]
TASK = dataclasses.replace(
    box_task.TASK,
    name="photographed",
    bodies=(Body("arm", "", box_task.TASK.bodies[0].environment, pictures=lambda: PICTURES),),
)
