"""Tools of the checks: a law that holds or fails in one line, equal arrays, actions of a space, counted traces."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_jax.spaces import Space

TRACED = "what depends on traced values must be jax.numpy, with jnp.where and lax.cond in place of if"


class Laws:
    """The laws of one subject."""

    def __init__(self, subject: Any, tolerance: float) -> None:
        """`subject`: the beginning of messages, a string or an object whose class is named."""
        self.subject = subject if isinstance(subject, str) else type(subject).__name__
        self.tolerance = tolerance

    def hold(self, law: Any, broken: str) -> None:
        """Raise AssertionError with the broken law and how to fix it, unless the law holds."""
        if not law:
            raise AssertionError(f"{self.subject}: {broken}")

    @contextmanager
    def attempted(self, deed: str, mend: str) -> Iterator[None]:
        """Raise AssertionError in one line in place of any exception of the subject's code."""
        try:
            yield
        except AssertionError:
            raise
        except Exception as error:
            why = (str(error).strip().splitlines() or [""])[0][:160]
            raise AssertionError(f"{self.subject}: {deed} fails ({type(error).__name__}: {why}): {mend}") from error

    def same(self, one: Any, other: Any) -> bool:
        """Return whether two trees of arrays are equal, within the tolerance. Keys are compared by their words."""
        pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
        return all(
            np.shape(a) == np.shape(b) and np.allclose(a, b, self.tolerance, self.tolerance, equal_nan=True)
            for a, b in ((_numbers(a), _numbers(b)) for a, b in pairs)
        )

    def actions(self, space: Space, actions: Any, called: str) -> None:
        """Raise AssertionError unless rows (..., size) are actions of a space."""
        shape = np.shape(actions)
        self.hold(shape[-1:] == (space.size,), f"{called} has shape {shape}: an action has {space.size} entries")
        self.hold(np.isfinite(actions).all(), f"{called} is not finite everywhere: give an action in every situation")
        kept = self.same(space.retract(jnp.asarray(actions)), actions)
        self.hold(kept, f"{called} is not an action of the space: pass it through the space's `retract`")


class OnceTraced:
    """A function compiled by `jax.jit` that counts how often it was traced."""

    def __init__(self, function: Callable[..., Any]) -> None:
        """Wrap the function; nothing is compiled yet."""
        self.traces = 0

        def counted(*arguments: Any) -> Any:
            self.traces += 1
            return function(*arguments)

        self._compiled = jax.jit(counted)

    def __call__(self, *arguments: Any) -> Any:
        """Return the function's result."""
        return self._compiled(*arguments)


def pytree(laws: Laws, subject: Any, called: str) -> None:
    """Raise AssertionError unless an object is a pytree of numbers with comparable static fields."""
    leaves = jax.tree_util.tree_leaves_with_path(subject)
    laws.hold(
        not (len(leaves) == 1 and leaves[0][1] is subject),
        f"{called} is not a pytree: derive its class from flax.struct.PyTreeNode",
    )
    for path, leaf in leaves:
        laws.hold(
            isinstance(leaf, jax.Array | np.ndarray | np.generic | bool | int | float),
            f"field {jax.tree_util.keystr(path).lstrip('.')} is of type {type(leaf).__name__}, which is not traced: "
            "make it an array, or static by struct.field(pytree_node=False)",
        )
    with laws.attempted("hashing its static fields", "a static field must be hashable: a number, a string, a tuple"):
        for static in _statics(jax.tree.structure(subject)):
            hash(static)


def _statics(tree: Any) -> Iterator[Any]:
    """Return the static fields of all nodes of a tree that are not Python's own containers."""
    node = tree.node_data()
    if node is not None and node[0] not in (dict, list, tuple):
        yield node[1]
    for child in tree.children():
        yield from _statics(child)


def same_shapes(one: Any, other: Any) -> bool:
    """Return whether two trees have the same fields, shapes and types."""
    described = [
        (jax.tree.structure(tree), [(np.shape(leaf), leaf.dtype) for leaf in jax.tree.leaves(tree)])
        for tree in (one, other)
    ]
    return described[0] == described[1]


def change_floats(tree: Any) -> Any:
    """Return the tree with another value of every float, as a changed world has."""

    def other(leaf: Any) -> Any:
        return leaf * 1.01 if jnp.issubdtype(jnp.asarray(leaf).dtype, jnp.floating) else leaf

    return jax.tree.map(other, tree)


def _numbers(leaf: Any) -> np.ndarray:
    if jnp.issubdtype(getattr(leaf, "dtype", np.float32), jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    return np.asarray(leaf)
