"""A small picture of each kind of feedback: what a teacher says of a policy's actions, and what acts afterwards.

    python experiments/feedback_pictures.py                    all of them, into docs/figures/feedback (two minutes)
    python experiments/feedback_pictures.py --kinds relative --out pictures

The world is a line: a situation is a number, an action a height. The policy acts `OFFSET` too low everywhere. Each kind
is what `cl.adapt` makes of a teacher's answers; nothing is drawn by hand.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray
from matplotlib.figure import Figure

import cuelearner_jax as cl
from cuelearner_jax.adaptation.by_model import plain_scalars
from cuelearner_jax.config import GuideSizes
from cuelearner_jax.environment import Aims, Quantity, WholeObservations
from cuelearner_jax.guides import registry
from cuelearner_jax.spaces import Box, Cue
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.types import Step

UP, DOWN, GREY = "#0072B2", "#D55E00", "#808080"  # answers "up" and "down"; what is read on white and on black
HEIGHTS = Box((-1.0,), (1.0,), (Cue("height", ("up", "down"), ("ArrowUp", "ArrowDown"), "shares"),))
OFFSET = 0.4  # of the policy's actions from the right ones
EPS, BOUND = 0.08, 0.32  # of an answer, and of corrections: shares of the range, which is 2
LABELS = 60
SIZES = GuideSizes(feedback_layers=(32, 32), fit_steps=1000, fit_batch_size=32, labels_per_round=10)
TEACHERS = {"scalar": {"scalar_within_deg": 0.06}}  # a share of the range: how near an action is called good
FEEDBACK = ("relative", "intent", "reading", "demonstration", "scalar", "preference", "dcoach", "bdcoach", "clic")
SHOWN = (*FEEDBACK, "clic_shown", "heuristic")


def right(situation: Any) -> Any:
    """Return the right height for a situation from -1 to 1."""
    return 0.45 * jnp.sin(3.0 * situation) + 0.1


class Line(WholeObservations, struct.PyTreeNode):
    """One step in one situation; the reward is minus the distance from the right height."""

    actions: Box = struct.field(pytree_node=False, default=HEIGHTS)

    observation = (Quantity("situation", 1, "m"),)
    action = Quantity("height", 1, "m", "an action between -1 and 1")

    def reset(self, key: PRNGKeyArray) -> tuple[Array, Array]:
        """A situation drawn uniformly."""
        situation = jax.random.uniform(key, (1,), minval=-1.0, maxval=1.0)
        return situation, situation

    def step(self, key: PRNGKeyArray, state: Array, action: Float[Array, "1"]) -> tuple[Array, Step]:
        """The next situation, which does not depend on the action."""
        reward = -jnp.abs(action - right(state))[0]
        following, obs = self.reset(key)
        return following, Step(obs, state, state, reward, jnp.array(True), jnp.array(False), {}, {})

    def aims(self, obs: Float[Array, "1"]) -> Aims:
        """Three heights that somebody may have in mind; the features say which curve each belongs to."""
        heights = jnp.stack([right(obs), right(obs) - 0.75, jnp.full_like(obs, -0.35)])
        return Aims(heights, jnp.eye(3), jnp.ones(3, bool))

    def heuristic(self, obs: Float[Array, "1"]) -> Float[Array, "1"]:
        """The obvious action: a constant height, which is right nowhere but by chance."""
        return jnp.full_like(obs, 0.1)


def before(obs: np.ndarray) -> np.ndarray:
    """The policy's actions (n, 1): too low by `OFFSET` everywhere."""
    return np.clip(np.asarray(right(obs)) - OFFSET, -1.0, 1.0)


def teacher(obs: np.ndarray) -> np.ndarray:
    """The right actions (n, 1)."""
    return np.asarray(right(obs))


SITUATIONS = np.linspace(-1, 1, 161, dtype=np.float32)[:, None]


def corrected(kind: str) -> tuple[Any, Any]:
    """Return the policy that `cl.adapt` makes of `LABELS` answers, and the answers."""
    scalars = dataclasses.replace(plain_scalars(HEIGHTS), **TEACHERS.get(kind, {}))
    # Of uniform actions few are good, so good/bad needs more answers than the others do.
    count = 4 * LABELS if kind == "scalar" else LABELS
    bounded = {} if registry.find(kind).by_evidence else {"sizes": SIZES, "bound_deg": BOUND, "scalars": scalars}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a model is not used is no matter: its picture is wanted
        better = cl.adapt(before, Line(), teacher, labels=count, guidance=kind, eps_deg=EPS, seed=1, **bounded)
    return better, jax.tree.map(lambda leaf: np.asarray(leaf[0]), better.outcome.result.labels)


def plot(kind: str, labels: Any, after: np.ndarray) -> Figure:
    """Draw the one picture that all kinds share; readable on white and on black."""
    found = registry.guides().get(kind)
    colour = found.colour if found else "#0072B2"
    figure = Figure(figsize=(4.2, 2.5), layout="constrained", facecolor="none")
    axes = figure.subplots()
    axes.set_facecolor("none")
    axes.plot(SITUATIONS, before(SITUATIONS), ":", color=GREY, linewidth=1.6, label="before")
    axes.plot(SITUATIONS, right(SITUATIONS), "--", color=GREY, linewidth=1.6, label="right")
    if kind == "intent":
        others = np.asarray(jax.vmap(Line().aims)(jnp.asarray(SITUATIONS)).actions)[:, 1:, 0]
        axes.plot(SITUATIONS, others, color=GREY, linewidth=0.7, alpha=0.7)
    axes.plot(SITUATIONS, after, color=colour, linewidth=2.4, label="after", zorder=4)
    if labels is not None:
        answers(axes, registry.find(kind).form, labels)
    axes.set(xlim=(-1, 1), ylim=(-1, 1), xticks=[], yticks=[])
    axes.set_xlabel("situation", color=GREY, loc="left")
    axes.set_ylabel("action", color=GREY)
    for spine in axes.spines.values():
        spine.set_color(GREY)
    where = {"loc": "upper right", "bbox_to_anchor": (1.0, -0.03), "borderaxespad": 0.0}
    axes.legend(**where, frameon=False, fontsize=8.5, labelcolor=GREY, ncols=3)
    return figure


def answers(axes: Any, form: Any, labels: Any) -> None:
    """Draw each answer where its question lies."""
    keep = np.asarray(labels.valid, bool)
    where, action = labels.obs[keep, 0], labels.action[keep, 0]
    answer = np.asarray(labels.answer)[keep]
    said = answer[:, 0]
    style: dict[str, Any] = {"linestyle": "", "markersize": 5.5, "alpha": 0.9, "zorder": 3}
    if form.name == "demonstration":
        axes.vlines(where, action, said, color=GREY, linewidth=0.8)
        axes.plot(where, said, marker="*", color="#009E73", **{**style, "markersize": 7})
        return
    if form.name == "scalar":
        axes.plot(where[said < 0.5], action[said < 0.5], marker="x", color=DOWN, **{**style, "markersize": 4})
        axes.plot(where[said > 0.5], action[said > 0.5], marker="o", color="#009E73", **style)
        return
    if form.name == "preference":
        axes.vlines(where, action, answer[:, 1], color=GREY, linewidth=0.6)
        better, clear = np.where(said < 0, action, answer[:, 1]), said != 0
        axes.plot(where[clear], better[clear], marker="o", color="#009E73", **style)
        return
    for value, marker, colour in ((1, "^", UP), (-1, "v", DOWN), (0, "o", GREY)):
        axes.plot(where[said == value], action[said == value], marker=marker, color=colour, **style)


def main() -> None:
    """Draw the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="*", default=SHOWN, choices=SHOWN)
    parser.add_argument("--out", type=Path, default=Path("docs/figures/feedback"))
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    matplotlib.rcParams["svg.hashsalt"] = "feedback"  # the same bytes each time
    file = asked.out / "pictures.json"
    told = json.loads(file.read_text()) if file.exists() else {}
    for kind in asked.kinds:
        if kind == "heuristic":
            labels, after = None, np.full(len(SITUATIONS), 0.1)
        else:
            better, labels = corrected(kind)
            after = np.asarray(better(SITUATIONS))[:, 0]
        plot(kind, labels, after).savefig(asked.out / f"{kind}.svg", metadata={"Date": None}, transparent=True)
        wrong = float(np.abs(after - np.asarray(right(SITUATIONS))[:, 0]).mean() / OFFSET)
        count = 0 if labels is None else int(np.asarray(labels.valid).sum())
        told[kind] = {"labels": count, "error_left": round(wrong, 3)}
        print(f"{kind}: {count} labels leave {100 * wrong:.0f}% of the error")
    told["made"] = {**provenance(), "command": "python experiments/feedback_pictures.py"}
    file.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main()
