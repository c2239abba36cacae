"""Decisions as graphs: every operation says in NumPy and in ONNX what it says in JAX."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest
from jax import lax

from cuelearner_jax.export import onnx_graph, operations, rules
from cuelearner_jax.export.graph import trace

SIZE = 12
TABLE = np.arange(60.0, dtype=np.float32).reshape(3, 4, 5)
MATRICES = np.random.default_rng(1).normal(size=(4, 3, 2)).astype(np.float32)
BIAS = np.repeat(np.array([-9, 0, 9], np.float32), 10)
ALONG = np.random.default_rng(2).normal(size=(SIZE, 7)).astype(np.float32)


def places(obs):
    """Whole numbers that hang on the observation, from -3 to 12."""
    return jnp.floor(6 * obs).astype(jnp.int32)


def looped(obs):
    """Halves what is above 1 until nothing is, beside a product that is the same in every pass."""
    test = lambda carry: (carry[1] < 20) & jnp.any(carry[0] > 1.0)  # noqa: E731
    body = lambda carry: (jnp.where(carry[0] > 1.0, carry[0] / 2, carry[0]) + 0 * (obs @ ALONG)[:2], carry[1] + 1)  # noqa: E731
    found, passes = lax.while_loop(test, body, (40 * obs[:2], 0))
    return found + passes


def scanned(obs):
    last, rows = lax.scan(lambda carry, x: (carry + x, carry * x), jnp.zeros(3), obs.reshape(4, 3), reverse=True)
    return jnp.concatenate([last, rows.ravel()])


def layers(obs, floor=0.0, batch=False):
    """Candidates through two layers; of the first, units are dead for all, for some and for none of them."""
    random = np.random.default_rng(3)
    each, one, two = (random.normal(size=size).astype(np.float32) for size in ((40, 30), (30, 20), (20, 3)))
    one *= 0.05  # so that sums stay small enough to be compared
    shared = obs @ random.normal(size=(SIZE, 30)).astype(np.float32) + BIAS
    first = jnp.maximum(each + shared[None], floor)
    if batch:
        return jnp.maximum(first.reshape(4, 10, 30) + obs[0], floor) @ np.stack([one] * 4)
    return jnp.maximum(first @ one + two[None, :, 0], floor) @ two


FUNCTIONS = {
    "elementwise": lambda o: jnp.exp(o) - jnp.log1p(o) * jnp.tanh(o) + jnp.sin(o) / jnp.cos(o) + jnp.expm1(o) ** 3,
    "signs": lambda o: jnp.sign(o - 0.5) * jnp.abs(o - 0.5) + jnp.floor(3 * o) + jnp.ceil(3 * o) + lax.rsqrt(o + 1),
    "remainder": lambda o: jnp.mod(7 * o - 3, 2.0) + jnp.mod(places(o) - 4, 5),
    "angle": lambda o: jnp.arctan2(o[:6] - 0.5, o[6:] - 0.5) + jnp.arctan(o[:6]),
    "angle on axes": lambda o: jnp.arctan2(
        jnp.round(o[:1] * 0) + jnp.array([0.0, 0, 1, -1]), jnp.array([1.0, -1, 0, 0])
    ),
    "sigmoid": lambda o: jax.nn.sigmoid(o) + jax.nn.softmax(o) + jnp.square(o) + jnp.sqrt(o) + jax.nn.relu(o - 0.5),
    "logic": lambda o: jnp.where(
        (o > 0.5) & ~(o < 0.7) | (o == o[0]) ^ (o != o[1]) | jnp.isfinite(jnp.log(o - 0.4)), o, -1
    ),
    "reductions": lambda o: jnp.stack(
        [o.sum(), o.max(), o.min(), o.prod(), (o > 0.9).any() * 1.0, (o > 0.0).all() * 1.0]
    ),
    "places": lambda o: jnp.stack([jnp.argmax(o.reshape(3, 4), 0), jnp.argmin(o.reshape(3, 4), 0)]) * 1.0,
    "clip": lambda o: jnp.clip(o, 0.3, o[0] + 0.3) + jnp.clip(places(o), 0, 2),
    "shapes": lambda o: jnp.flip(o.reshape(3, 4).T, 0)[::2, 1:] + jnp.broadcast_to(o[:2], (2, 2)),
    "parts": lambda o: jnp.concatenate([*jnp.split(o, 3), jnp.roll(o, 5), jnp.stack([o, o], 1).ravel()]),
    "padding": lambda o: lax.pad(o.reshape(3, 4), o[0], ((1, -1, 0), (-1, 2, 0))),
    "index": lambda o: jnp.asarray(TABLE)[places(o[0]), 1, places(o[1:4])] + o[places(o[:3])],
    "index out of range": lambda o: jnp.asarray(TABLE).at[places(o)].get(mode="fill", fill_value=-1.0).sum((1, 2)),
    "slices": lambda o: lax.dynamic_slice(jnp.asarray(TABLE), (places(o[0]), 0, places(o[1])), (2, 3, 2)) + o[0],
    "slices of rows": lambda o: jax.vmap(lambda n: lax.dynamic_slice(o, (n,), (5,)))(places(o[:4])),
    "batched index": lambda o: jax.vmap(lambda row, n: row[n])(o.reshape(4, 3), places(o[:4])),
    "products": lambda o: jnp.einsum("bij,bk->jbki", MATRICES, o.reshape(4, 3)) + (o @ ALONG)[:, None, None, None][:2],
    "highest": lambda o: jnp.concatenate([(found := lax.top_k(jnp.round(3 * o), 5))[0], found[1] * 1.0]),
    "sums so far": lambda o: jnp.cumsum(o.reshape(3, 4), 1),
    "branches": lambda o: lax.switch(places(o[0]), [lambda x: x, lambda x: -x, lambda x: 2 * x], o),
    "loop": looped,
    "scan": scanned,
    "layers": layers,
    "layers that stop elsewhere": lambda o: layers(o, floor=-0.5),
    "layers of batches": lambda o: layers(o, batch=True),
    "layers of one row": lambda o: jax.nn.relu(o + ALONG[:, 0]) @ ALONG,
    "rough": lambda o: (o.astype(jnp.bfloat16) * jnp.bfloat16(1.7) + jnp.bfloat16(0.3)).astype(jnp.float32),
    "known": lambda o: o + jax.random.normal(jax.random.key(3), (SIZE,)),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_numpy_and_onnx_say_what_jax_says(name):
    def function(key, obs):
        return FUNCTIONS[name](obs).astype(jnp.float32).ravel()

    assert rules.RULES
    traced = trace(function, SIZE)
    assert (traced.missing, traced.random) == ((), False)
    graph = json.loads(json.dumps(traced.graph.as_json()))
    run = operations.compile_ops(graph["ops"], set(graph["outputs"]))
    drawn = np.random.default_rng(0).random((6, SIZE), dtype=np.float32) * 1.2
    with jax.numpy_rank_promotion("allow"):
        wanted = np.stack([np.asarray(function(None, obs)) for obs in drawn])
    values = [{**traced.constants, "obs": obs} for obs in drawn]
    found = []
    for each in values:
        with np.errstate(all="ignore"):
            run(each)
        found.append(np.array(each[graph["outputs"][0]]))
    np.testing.assert_allclose(np.stack(found), wanted, rtol=2e-6, atol=2e-6)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(onnx_graph.serialize(traced, SIZE, wanted.shape[1]), options)
    np.testing.assert_allclose(session.run(None, {"obs": drawn})[0], wanted, rtol=5e-6, atol=5e-6)


def test_what_no_rule_says_is_named_and_only_if_it_is_needed():
    traced = trace(lambda key, obs: jnp.sort(obs) + lax.cumsum(obs, reverse=True), SIZE)
    assert traced.missing == ("cumsum", "sort")
    traced = trace(lambda key, obs: obs + 0 * jnp.sort(obs).shape[0], SIZE)
    assert traced.missing == ()


def test_an_action_that_hangs_on_the_key_is_found_out():
    assert trace(lambda key, obs: obs[:2] + jax.random.normal(key, (2,)), SIZE).random
    assert not trace(lambda key, obs: (obs[:2], jax.random.normal(key, (2,)))[0], SIZE).random


def test_what_no_pass_changes_is_done_once_before_a_loop():
    ops = trace(lambda key, obs: looped(obs), SIZE).graph.ops
    (loop,) = [op for op in ops if op[0] == "while"]
    assert "matmul" in [op[0] for op in ops]
    assert "matmul" not in [op[0] for op in loop[3]["body"]["ops"]]


def test_units_that_no_candidate_turns_on_are_left_out_of_products(monkeypatch):
    traced = trace(lambda key, obs: layers(obs), SIZE)
    run = operations.compile_ops(traced.graph.ops, set(traced.graph.outputs))
    product, widths = np.matmul, []
    monkeypatch.setattr(np, "matmul", lambda x, y, out=None: widths.append(x.shape[1]) or product(x, y, out=out))
    run({**traced.constants, "obs": np.zeros(SIZE, np.float32)})
    each = np.random.default_rng(3).normal(size=(40, 30)).astype(np.float32)
    assert widths[0] == ((each + BIAS) > 0).any(0).sum() == 20  # a third can never be on


def test_what_was_done_is_not_done_again():
    def twice(key, obs):
        return jnp.sin(obs[:2]) * jnp.sin(obs[:2]) + jnp.where((obs[:1] > 0)[None], obs[None, :2], 1.0)[0]

    names = [op[0] for op in trace(twice, SIZE).graph.ops]
    assert names.count("sin") == 1
    assert "broadcast" not in names
