"""Blocks of lanes: how they are cut, what memory they need."""

import dataclasses

import chex
import jax
import numpy as np
from probes import CONFIG, Window

from cuelearner_jax.devices import compiler_options
from cuelearner_jax.guides import registry as guidance
from cuelearner_jax.runs import lanes
from cuelearner_jax.runs.grid import Grid


def group_of(seeds, kind="none", config=CONFIG, **sizes):
    config = dataclasses.replace(config, sizes=dataclasses.replace(config.sizes, **sizes))
    env = Window()
    made = guidance.make(kind, config.sizes, env)
    return lanes.LaneGroup(config, env, made, Grid((kind,), tuple(range(seeds)), (10, 20)))


def test_blocks_are_equal_and_the_last_is_filled_with_repeats():
    group = group_of(5, lanes_per_block=2)
    assert [list(seeds) for seeds, _ in group.blocks()] == [[0, 1], [2, 3], [4, 4]]
    columns = group.columns([{"reward": seeds * 1.0} for seeds, _ in group.blocks()])
    np.testing.assert_array_equal(columns["reward"], [0.0, 1.0, 2.0, 3.0, 4.0])


def test_a_program_is_made_for_the_lanes_that_a_device_takes_at_once(monkeypatch):
    made = []
    monkeypatch.setattr(lanes, "make_program", lambda *arguments, lanes: made.append(lanes))
    group_of(5, lanes_per_block=2)
    group_of(40, lanes_per_block=40)
    assert made == [2, 40]
    assert compiler_options(40) == {}
    with monkeypatch.context() as patch:
        patch.setattr(jax, "default_backend", lambda: "gpu")
        few, many = (compiler_options(lanes) for lanes in made)
    assert (few["xla_gpu_enable_triton_gemm"], many["xla_gpu_enable_triton_gemm"]) == (True, False)
    assert jax.jit(lambda x: x + 1, compiler_options=many)(1) == 2  # XLA refuses names that it does not know


def test_blocks_of_another_cut_are_cut_anew(monkeypatch):
    monkeypatch.setattr(lanes, "CORES", 1)
    before, after = group_of(5, lanes_per_block=2), group_of(5)
    (joined,) = after.recut(before.start())
    chex.assert_trees_all_equal(joined, *after.start())
    chex.assert_trees_all_equal(after.recut([joined]), [joined])
