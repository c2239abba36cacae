"""The checker of shapes itself: it is in force, and lets through what JAX does with pytrees."""

import jax
import jax.numpy as jnp
import pytest
from jaxtyping import TypeCheckError

from cuelearner_envs.navigation.geometry import in_frame


def test_an_array_of_another_shape_than_the_signatures_is_refused():
    assert in_frame(jnp.zeros((3, 5)), jnp.zeros(2)).shape == (3, 2)
    with pytest.raises(TypeCheckError, match="boxes"):
        in_frame(jnp.zeros((3, 4)), jnp.zeros(2))
    with pytest.raises(TypeCheckError):
        jax.eval_shape(in_frame, jnp.zeros((3, 5)), jnp.zeros(3))
