"""The checker of shapes itself: it is in force, and lets through what JAX does with pytrees."""

from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from checked import LOOSE_RANKS
from jaxtyping import TypeCheckError

from cuelearner_envs.navigation.geometry import in_frame
from cuelearner_jax.storage.label_files import found_in


def test_an_array_of_another_shape_than_the_signatures_is_refused():
    assert in_frame(jnp.zeros((3, 5)), jnp.zeros(2)).shape == (3, 2)
    with pytest.raises(TypeCheckError, match="boxes"):
        in_frame(jnp.zeros((3, 4)), jnp.zeros(2))
    with pytest.raises(TypeCheckError):
        jax.eval_shape(in_frame, jnp.zeros((3, 5)), jnp.zeros(3))


def test_functions_that_name_no_array_are_checked_too():
    with pytest.raises(TypeCheckError, match="place"):
        found_in("a string")  # pyright: ignore[reportArgumentType]


def test_the_folders_of_loose_ranks_exist():
    assert all((Path(__file__).parent / folder).exists() for folder in LOOSE_RANKS)
