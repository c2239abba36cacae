"""Lanes over four devices, forced on a CPU: what they learn is what one device's lanes learn."""

import gc
import os
import re
import subprocess
import sys
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import many_devices
import numpy as np
import pytest

from cuelearner_jax.devices import (
    BY_LANE,
    SHARED,
    commit_arrays,
    each_lane,
    each_lane_in_place,
    lane_mesh,
    over_lanes,
    place,
    release_programs,
)
from cuelearner_jax.storage import results

SCRIPT = Path(many_devices.__file__)


def on_four(*arguments):
    settings = {**os.environ, "JAX_NUM_CPU_DEVICES": "4", "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, str(SCRIPT), *(str(argument) for argument in arguments)]
    done = subprocess.run(command, env=settings, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.strip()


def test_empty_arrays_do_not_enter_the_shared_program():
    double = over_lanes(lane_mesh(), lambda by, lanes: jax.tree.map(by.__mul__, lanes), (SHARED, BY_LANE), BY_LANE)
    two, lanes = jnp.asarray(2.0), {"labels": jnp.zeros((4, 0)), "values": jnp.arange(4.0)}
    (call,) = jax.make_jaxpr(double)(two, lanes).eqns
    assert [value.aval.shape for value in call.invars] == [(), (4,)]
    chex.assert_trees_all_equal(double(two, lanes), {"labels": jnp.zeros((4, 0)), "values": 2 * jnp.arange(4.0)})


@pytest.mark.parametrize(("lanes", "backend", "rank"), [(1, "cpu", 2), (3, "cpu", 2), (1, "gpu", 2), (3, "gpu", 3)])
def test_lanes_are_side_by_side_on_an_accelerator_alone(monkeypatch, lanes, backend, rank):
    left, right = jax.random.normal(jax.random.key(0), (2, lanes, 5, 5))
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    mapped = each_lane(lambda left, right: {"product": left @ right})
    in_place = each_lane_in_place(lambda pair: ((pair[0] @ pair[1], pair[1]), jnp.asarray(7), pair[1].sum()))
    for function, blocks in ((mapped, (left, right)), (in_place, ((left, right),))):
        (shape,) = re.findall(r"f32\[([^]]*)\] = dot_general", str(jax.make_jaxpr(function)(*blocks)))
        assert len(shape.split(",")) == rank
    expected = np.matmul(left, right)
    np.testing.assert_allclose(mapped(left, right)["product"], expected, rtol=1e-4, atol=1e-5)
    (found, same), common, own = in_place((left, right))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(same, right)
    assert common == 7
    np.testing.assert_allclose(own, right.sum((1, 2)), rtol=1e-4, atol=1e-5)


def measured(folder):
    order = lambda row: (row["guidance"], row["labels"], row["seed"], row["step"])  # noqa: E731
    rows = sorted(results.read(folder).to_pylist(), key=order)
    names = [name for name in rows[0] if isinstance(rows[0][name], int | float) and name != "wall_s"]
    return {name: np.array([np.nan if row[name] is None else row[name] for row in rows], float) for name in names}


@pytest.mark.long
def test_no_device_waits_for_another():
    assert on_four("communication") == "4 []"


@pytest.mark.long
def test_a_run_begun_on_four_devices_goes_on_with_one(tmp_path):
    alone, out = tmp_path / "alone", tmp_path / "run"
    many_devices.run(alone)
    on_four(out, 5)  # three rounds of labels, then in the middle of training
    many_devices.run(out, resume=True)
    chex.assert_trees_all_close(measured(out), measured(alone), rtol=1e-5, atol=1e-6)


def test_programs_are_forgotten_above_half_of_the_allowed_maps_and_compiled_again(tmp_path, monkeypatch):
    (tmp_path / "vm").mkdir()
    traces = []

    @jax.jit
    def double(x):
        traces.append(x)
        return 2 * x

    monkeypatch.setattr(jax, "clear_caches", double.clear_cache)  # other tests keep their programs
    monkeypatch.setattr(gc, "collect", lambda: 0)
    for maps, forgotten in ((5, False), (6, True)):
        (tmp_path / "maps").write_text("a map\n" * maps)
        (tmp_path / "vm" / "max_map_count").write_text("10\n")
        assert double(3) == 6
        assert release_programs(process=tmp_path, system=tmp_path) == forgotten
        assert double(3) == 6
    assert len(traces) == 2
    assert not release_programs(process=tmp_path / "nowhere", system=tmp_path)  # as on another system than Linux


def test_arrays_of_one_device_are_alike_to_a_program_wherever_they_came_from():
    one = lane_mesh(jax.local_devices()[:1])
    program = jax.jit(chex.assert_max_traces(lambda values, key: values + jax.random.uniform(key), n=1))
    for values in (
        jnp.ones(3),
        place(one, jnp.ones(3), SHARED),
        program(*commit_arrays((jnp.ones(3), jax.random.key(0)))),
    ):
        program(*commit_arrays((values, jax.random.key(0))))
    assert program._cache_size() == 1
