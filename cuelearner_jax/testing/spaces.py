"""Check the laws of an action space (`cuelearner_jax.spaces.Space`) on actions that it draws."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_jax.spaces import Space, from_json
from cuelearner_jax.testing.laws import Laws

DRAWN = 64  # actions


def check_space(space: Space, tolerance: float = 1e-5) -> None:
    """Check that a space keeps its laws.

    Raises:
        AssertionError: the first law that is broken.
    """
    laws = Laws(space, tolerance)
    with laws.attempted("hashing", "derive a frozen dataclass, whose fields are numbers, strings and tuples"):
        hash(space)
    with laws.attempted("reading its description", "give `of_json` for what `to_json` says beyond name and cues"):
        laws.hold(from_json(space.to_json()) == space, "its description gives another space: see `to_json`, `of_json`")
    keys = [key for cue in space.cues for key in cue.keys]
    laws.hold(len(set(keys)) == len(keys), f"a key stands twice among {keys}: give each word of a cue its own")
    with laws.attempted("drawing and comparing actions", "every method takes any leading axes, under jit too"):
        one, other = (space.sample(jax.random.key(seed), (DRAWN,)) for seed in (0, 1))
        far = jax.jit(space.log)(one, other)
        gone, back = jax.jit(space.exp)(one, far), space.retract(one)
        spread = space.spread(DRAWN)
    laws.hold(np.shape(far) == (DRAWN, len(space.cues)), f"`log` has shape {np.shape(far)}: give one number a cue")
    for called, actions in (("what `sample` gives", one), ("what `exp` gives", gone), ("what `spread` gives", spread)):
        laws.actions(space, actions, called)
    laws.hold(laws.same(back, one), "`retract` changes actions: it must leave them as they are")
    if space.cues:
        laws.hold(laws.same(gone, other), "exp(a, log(a, b)) is not b: `exp` must go where `log` says")
        laws.hold(laws.same(space.log(one, one), np.zeros_like(far)), "log(a, a) is not 0 along every cue")
        farthest = float(np.max(np.abs(space.to_unit(np.asarray(far), np))))
        laws.hold(farthest <= space.reach * (1 + tolerance), f"`log` goes as far as {farthest:g}: beyond `reach`")
    lost = space.retract(one.at[0].set(jnp.nan))
    laws.hold(np.isnan(lost[0]).all(), "`retract` of NaN is not NaN: return NaN, so that a fault of user code is seen")
