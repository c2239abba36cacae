"""Decisions as graphs: every operation says in NumPy and in ONNX what it says in JAX."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest
from jax import lax

from cuelearner_jax.export import decisions, onnx_graph, runner

trace = decisions.trace
SIZE = 12
TABLE = np.arange(60.0, dtype=np.float32).reshape(3, 4, 5)
MATRICES = np.random.default_rng(1).normal(size=(4, 3, 2)).astype(np.float32)
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


FUNCTIONS = {
    "shapes": lambda o: jnp.flip(o.reshape(3, 4).T, 0)[::2, 1:] + jnp.broadcast_to(o[:2], (2, 2)),
    "parts": lambda o: jnp.concatenate([*jnp.split(o, 3), jnp.roll(o, 5), jnp.stack([o, o], 1).ravel()]),
    "padding": lambda o: lax.pad(o.reshape(3, 4), o[0], ((1, 0, 0), (0, 2, 0))),
    "index": lambda o: jnp.asarray(TABLE)[places(o[0]), 1, places(o[1:4])] + o[places(o[:3])],
    "slices": lambda o: lax.dynamic_slice(jnp.asarray(TABLE), (places(o[0]), 0, places(o[1])), (2, 3, 2)) + o[0],
    "slices of rows": lambda o: jax.vmap(lambda n: lax.dynamic_slice(o, (n,), (5,)))(places(o[:4])),
    "batched index": lambda o: jax.vmap(lambda row, n: row[n])(o.reshape(4, 3), places(o[:4])),
    "products": lambda o: jnp.einsum("bij,bk->jbki", MATRICES, o.reshape(4, 3)) + (o @ ALONG)[:, None, None, None][:2],
    "branches": lambda o: lax.switch(places(o[0]), [lambda x: x, lambda x: -x, lambda x: 2 * x], o),
    "loop": looped,
    "scan": scanned,
    "layer": lambda o: jax.nn.relu(o + ALONG[:, 0]) @ ALONG,
    "known": lambda o: o + jax.random.normal(jax.random.key(3), (SIZE,)),
}


def decided(traced, drawn, size):
    """The actions of a graph in NumPy, and in ONNX."""
    graph = json.loads(json.dumps(traced.graph._asdict()))
    run, found = runner.compile_ops(graph["ops"]), []
    for obs in drawn:
        values = {**traced.constants, "obs": obs}
        with np.errstate(all="ignore"):
            run(values)
        found.append(np.array(values[graph["outputs"][0]]))
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(onnx_graph.serialize(traced, [drawn.shape[1]], [size]), options)
    return np.stack(found), session.run(None, {"obs": drawn})[0]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_numpy_and_onnx_say_what_jax_says(name):
    def function(key, obs):
        return FUNCTIONS[name](obs).astype(jnp.float32).ravel()

    traced = trace(function, SIZE)
    assert (traced.missing, traced.random) == ((), False)
    drawn = np.random.default_rng(0).random((6, SIZE), dtype=np.float32) * 1.2
    with jax.numpy_rank_promotion("allow"):
        wanted = np.stack([np.asarray(function(None, obs)) for obs in drawn])
    for actions, near in zip(decided(traced, drawn, wanted.shape[1]), (2e-6, 5e-6), strict=True):
        np.testing.assert_allclose(actions, wanted, rtol=near, atol=near)


NUMBERS = [0, -0.0, 1, -1, 0.5, -0.5, 1.5, 2.5, -2.5, 3, 7, -7, 0.3, -0.9999, 1e-10, -1e-10, 1e-30, 2.4e-38, 20, -20]
NUMBERS += [100, -100, 1e4, 46341, 65537, 1e10, -1e10, 3e38, -3e38, 2147483520, 2.0**31, -(2.0**31), -2147483904]
NUMBERS = np.array([*NUMBERS, 2.0**32, np.inf, -np.inf, np.nan], np.float32)
ROWS = np.random.default_rng(4).integers(len(NUMBERS), size=(200, 5))
KINDS = {"float32": lambda x: x, "int32": lambda x: x.astype(jnp.int32), "bool": lambda x: x > 0.7}
COMPARED = {name: getattr(lax, name) for name in ("eq", "ne", "lt", "le", "gt", "ge")}
UNARY = "neg abs sign floor ceil exp log log1p expm1 sin cos tan tanh atan sqrt rsqrt square logistic is_finite"
SINGLE = {
    "float32": {
        **{name: getattr(lax, name) for name in UNARY.split()},
        **{f"integer_pow {y}": lambda x, y=y: lax.integer_pow(x, y) for y in (-2, 0, 1, 2, 3, 5)},
        **{name: lambda x, to=name: x.astype(to) for name in ("int32", "bool")},
        "round": jnp.round,
        "log of sigmoid": lambda x: jnp.log(jax.nn.sigmoid(x)),
        "clip": lambda x: jnp.clip(x, -1, 2),
    },
    "int32": {
        **{name: getattr(lax, name) for name in ("neg", "abs", "sign", "square")},
        **{f"integer_pow {y}": lambda x, y=y: lax.integer_pow(x, y) for y in (0, 1, 2, 3, 7)},
        **{f"div {y}": lambda x, y=y: lax.div(x, y) for y in (-3, 2)},
        **{f"rem {y}": lambda x, y=y: lax.rem(x, y) for y in (-3, 2)},
        **{f"floor_divide {y}": lambda x, y=y: x // y for y in (-3, 2)},
        **{name: lambda x, to=name: x.astype(to) for name in ("float32", "bool")},
        "clip": lambda x: jnp.clip(x, -5, 2**31 - 2),
    },
    "bool": {"not": lax.bitwise_not, **{name: lambda x, to=name: x.astype(to) for name in ("float32", "int32")}},
}
PAIRED = {
    "float32": {
        **{name: getattr(lax, name) for name in ("add", "sub", "mul", "div", "rem", "atan2", "max", "min")},
        "pow": lambda x, y: lax.pow(jnp.where(jnp.isinf(x), 2.0, x), y),  # of -inf, NumPy's is not IEEE's
        "mod": jnp.mod,
    },
    "int32": {name: getattr(lax, name) for name in ("add", "sub", "mul", "max", "min")},
    "bool": {f"bitwise {n}": getattr(lax, f"bitwise_{n}") for n in ("and", "or", "xor")}
    | {"max": lax.max, "min": lax.min},
}
for _each in PAIRED.values():
    _each |= COMPARED | {"select": lambda x, y: jnp.where(x == y, x, ~x if x.dtype == bool else -y)}
OF_ROWS = {  # of five numbers, and the first of them as an index
    **{name: getattr(jnp, name) for name in ("max", "min", "argmax", "argmin", "any", "all")},
    "taken": lambda x: x[x[0].astype(jnp.int32)],
    "filled": lambda x: x.at[x[0].astype(jnp.int32)].get(mode="fill"),
    "filled at known places": lambda x: x.at[jnp.array([1, 5, -6])].get(mode="fill"),
    "sliced": lambda x: lax.dynamic_slice(x, (x[0].astype(jnp.int32),), (2,)),
    "switched": lambda x: lax.switch(x[0].astype(jnp.int32), [lambda v: v, lambda v: v[::-1]], x),
    "padded": lambda x: jnp.pad(x, 1),
    "barrier": lambda x: jnp.stack(lax.optimization_barrier((x, x[::-1]))),
}
SMALL = {"sum": jnp.sum, "product": lambda x: x[:4].reshape(2, 2) @ x[1:].reshape(2, 2)}
REDUCED = {
    "float32": {**OF_ROWS, **{name: lambda x, of=of: of(jnp.round(jnp.clip(x, -9, 9))) for name, of in SMALL.items()}},
    "int32": {**OF_ROWS, **SMALL},
    "bool": OF_ROWS | {"sum": jnp.sum},
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_primitive_does_with_extreme_numbers_what_xla_does(kind):
    """Saturating casts, wrapping integers, division by zero, NaN in comparisons, ties, places out of range."""

    def parts(obs):
        x = KINDS[kind](obs)
        left, right = (jnp.broadcast_to(each, (len(NUMBERS),) * 2) for each in (x, x[:, None]))
        found = {f"{name}(x)": function(x) for name, function in SINGLE[kind].items()}
        found |= {f"{name}(x, y)": function(left, right) for name, function in PAIRED[kind].items()}
        return found | {f"{name}(row)": jax.vmap(of)(x[ROWS]) for name, of in REDUCED[kind].items()}

    function = lambda key, obs: jnp.concatenate([v.ravel().astype(jnp.float32) for v in parts(obs).values()])  # noqa: E731
    traced = trace(function, len(NUMBERS))
    assert traced.missing == ()
    wanted = np.asarray(jax.jit(function)(None, NUMBERS))
    each = {name: part.size for name, part in parts(jnp.asarray(NUMBERS)).items()}
    names = np.repeat(list(each), list(each.values()))
    for actions in decided(traced, NUMBERS[None], wanted.size):
        wrong = ~np.isclose(actions[0], wanted, rtol=3e-5, atol=1e-37, equal_nan=True)  # XLA rounds smaller ones to 0
        assert not wrong.any(), (sorted(set(names[wrong])), actions[0][wrong][:5], wanted[wrong][:5])


DIVISION = "a division of integers by 0, by -1, or by what depends on the observation"
REFUSED = {
    "bitwise and": (lax.bitwise_and, "bitwise logic of integers"),
    "division": (lax.div, DIVISION),
    "pow": (lambda x, y: lax.pow(jnp.float32(2) + 0.0 * x, y), "powers with an integer base or exponent"),
    "product": (lambda x, y: (x > 0) @ (y > 0), "products of booleans or of different types"),
    "bfloat16": (lambda x, y: (x.astype(jnp.bfloat16) + 1).astype(jnp.float32), "numbers of type bfloat16"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_a_graph_would_do_otherwise_is_refused(name):
    function, reason = REFUSED[name]
    integers = lambda key, obs: function(*jnp.split(obs.astype(jnp.int32), 2)).astype(jnp.float32)  # noqa: E731
    assert trace(integers, 4).missing == (reason,)


def test_what_no_rule_says_is_named_and_only_if_it_is_needed():
    traced = trace(lambda key, obs: jnp.sort(obs) + jnp.cumsum(obs), SIZE)
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
