"""Pictures: a policy that gives no actions is named, and nothing is written."""

import jax
import numpy as np
import pytest
from flax import struct
from probes import Window

from cuelearner_jax.errors import UserError
from cuelearner_jax.runs import filming
from cuelearner_jax.task import Pictures


class Drifting(struct.PyTreeNode):
    """Scales what it sees."""

    bad: float

    def act(self, key, states, obs):
        return self.bad * obs

    @property
    def axes(self):
        return self.replace(bad=None)


def record(env, policy, key, steps):
    play = jax.jit(lambda key: policy.act(key, None, env.reset(key)[1][None])[0])
    return [np.asarray(play(jax.random.fold_in(key, step))) for step in range(steps)], [0.0] * steps


def drawn(*arguments):
    arguments[-1].touch()


PICTURES = Pictures(record=record, still=drawn, animate=drawn, question=drawn)


@pytest.mark.parametrize("bad", [np.nan, 0.0, np.inf])
def test_a_policy_that_gives_no_actions_is_not_drawn(tmp_path, bad):
    files = filming.files(tmp_path / "new", "name", "gif")
    for draw in (
        lambda: filming.film(PICTURES, Window(), Drifting(bad), 0, 6, files),
        lambda: [filming.question(PICTURES, Window(), Drifting(bad), number, files.question) for number in range(6)],
    ):
        with pytest.raises(UserError, match="policy Drifting gave actions that are not finite, or zero"):
            draw()
    assert not files.film.exists()
    assert not files.still.exists()


def test_one_that_acts_is_drawn(tmp_path):
    files = filming.files(tmp_path / "new", "name", "gif")
    assert filming.film(PICTURES, Window(), Drifting(1.0), 0, 6, files) == [0.0] * 6
    assert files.film.exists()
    assert files.still.exists()
