"""A seed means one thing: JAX's switches for random numbers, precision and NaN change no result, and are on record."""

import jax
import numpy as np
import probes
import pytest

import cuelearner_jax as cl
from cuelearner_jax.cli import dispatch
from cuelearner_jax.config import GuideSizes
from cuelearner_jax.devices import NUMERICS
from cuelearner_jax.storage.provenance import provenance

OTHERS = {"default_prng_impl": "rbg", "threefry_partitionable": False, "enable_x64": True, "debug_nans": True}
WORLD = cl.World(probes.make_task(), probes.WindowConfig())
SIZES = GuideSizes(feedback_layers=(8,), fit_steps=20, fit_batch_size=8)


def numbers():
    """Episodes, a world of its seed, and a correction, from the command's and from Python's seeds alone."""
    teacher, ahead = cl.teacher_of(WORLD), lambda obs: np.tile([1.0, 0.0], (len(obs), 1))
    policy = cl.adapt(ahead, WORLD, teacher, labels=12, sizes=SIZES, guidance="relative")
    return cl.measure(policy, WORLD, steps=200, envs=10).each["reward"], policy(np.float64([[0.0, 1.0]]))


@pytest.fixture
def another_program():
    """Set JAX up as a program that computes in another way."""
    before = {name: getattr(jax.config, f"jax_{name}") for name in OTHERS}
    for name, value in OTHERS.items():
        jax.config.update(f"jax_{name}", value)
    yield
    for name, value in before.items():
        jax.config.update(f"jax_{name}", value)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_measure_and_adapt_return_the_same_numbers_in_any_program(request):
    plain = numbers()
    request.getfixturevalue("another_program")
    for own, other in zip(plain, numbers(), strict=True):
        assert other.dtype == np.float32
        np.testing.assert_array_equal(own, other)
    assert jax.config.jax_enable_x64  # the program keeps its own settings


def test_a_command_sets_jax_up_for_all_its_threads(another_program, capsys):
    assert dispatch.main(["report", "nowhere"]) == 2
    assert {name: getattr(jax.config, f"jax_{name}") for name in NUMERICS} == NUMERICS


def test_the_settings_are_on_record(another_program):
    assert "rbg not partitionable, float64" in provenance()["versions"]
