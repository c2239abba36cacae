"""A person as the judge: films of both policies from the same starts, without names."""

import numpy as np
import pytest
from gymnasium_worlds import Adder
from PIL import Image, ImageSequence

import cuelearner_jax as cl
from cuelearner_jax.config import GuideSizes

pytestmark = pytest.mark.filterwarnings("ignore:.*labels.*")


@pytest.fixture(scope="module")
def world():
    return cl.from_gymnasium(Adder, num_envs=4, processes=1)


def slow(obs):
    return np.full((len(obs), 1), 0.2, np.float32)


def fast(obs):
    return np.ones((len(obs), 1), np.float32)


def seconds(file):
    return sum(frame.info["duration"] for frame in ImageSequence.Iterator(Image.open(file)))


def adapted(world, judge_by, **more):
    sizes = GuideSizes(feedback_layers=(8,), fit_steps=100, fit_batch_size=16)
    return cl.adapt(slow, world, fast, labels=20, judge_by=judge_by, guidance="relative", sizes=sizes, **more)


def test_seven_clear_preferences_decide_and_films_change_sides(world):
    sides = []

    def sooner(left, right):
        """Adder ends as soon as the sum is large enough, so the better film is the shorter one."""
        sides.append(np.sign(seconds(left) - seconds(right)))
        return int(sides[-1])

    better = adapted(world, sooner)
    assert better.used
    assert better.judged == ("person", 0.0, 1.0)
    assert better.rewarded_steps == 0
    # mean over the stakes of (1 + stake)**n reaches 20 with the seventh
    assert len(sides) == 7
    assert set(sides) == {-1, 1}
    assert "a person preferred the policy as it was in 0%, the corrected in 100%" in better.words[-1]
