"""What a labelling session is configured to ask, and the replay of its situations."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from cuelearner_jax import asking
from cuelearner_jax.asking import GuideState
from cuelearner_jax.config import to_json
from cuelearner_jax.environment import Environment
from cuelearner_jax.feedback.answers import AnswerForm
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.policies import Policy
from cuelearner_jax.reading.families import Family
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.task import Task

APART = ("env", "teacher")  # fields of policies that describe the world; the label file records them separately
SAME = 1e-5  # largest difference of a replayed observation from the recorded one


class Base(NamedTuple):
    """The policy whose actions the questions are about."""

    policy: Policy
    name: str

    @property
    def digest(self) -> str:
        """Short hash of the policy's parameters; empty for a policy without JAX arrays."""
        leaves = [
            np.asarray(leaf)
            for path, leaf in jax.tree_util.tree_leaves_with_path(self.policy)
            if not any(getattr(part, "name", "") in APART for part in path)
        ]
        contents = b"".join(f"{leaf.dtype}{leaf.shape}".encode() + leaf.tobytes() for leaf in leaves)
        return hashlib.sha256(contents).hexdigest()[:12] if leaves else ""


@dataclass(frozen=True)
class SessionPlan:
    """Settings of a labelling session: who is asked, about what, and how many questions."""

    task: Task
    config: RunConfig  # whose world, sizes and scalars the session uses
    guidance: Guide
    base: Base
    labels: int  # number of answers wanted
    seed: int = 0
    who: str = "anonymous"
    # largest distance of a question from the base policy's action, in the space's unit; None: no bound
    bound_deg: float | None = None
    robot: str = ""  # the robot's body and its locomotion policy, where not the task's default
    again: tuple[dict[str, Any], ...] = ()  # rows of another session of this seed, whose questions are asked again
    again_of: str = ""  # digest of that session's file
    family: Family = ()  # reading only: what may have changed
    one_cue: bool = False  # whether one press about one of several cues is the whole answer

    @property
    def form(self) -> AnswerForm:
        """The answer form being collected."""
        assert self.guidance.form is not None
        return self.guidance.form

    @property
    def world(self) -> dict[str, Any]:
        """The task's name and configuration, as label files record them."""
        return {"name": self.task.name, **to_json(self.config.task)}

    @property
    def eps(self) -> float | None:
        """Strength of an answer in the space's unit; None where the form has no strength."""
        return self.config.scalars.eps_deg if self.form.by_eps else None

    def session(self, env: Any) -> dict[str, Any]:
        """Return the settings that must be equal for answers to share a file, beyond task and form."""
        return {
            "seed": self.seed,
            "guidance": self.guidance.name,
            "base": self.base.name,
            "base_digest": self.base.digest,
            "bound": self.bound_deg,
            **({"robot": self.robot} if self.robot else {}),
            **({"again_of": self.again_of} if self.again else {}),
            "observation": [{"name": part.name, "size": part.size, "unit": part.unit} for part in env.observation],
        }


class SessionKeys(NamedTuple):
    """Random keys of a session."""

    session: PRNGKeyArray  # for questions and fits
    model: PRNGKeyArray
    start: PRNGKeyArray  # for the first situation


def keys_of(seed: int) -> SessionKeys:
    """Derive a session's random keys from its seed."""
    return SessionKeys(*jax.random.split(jax.random.key(seed), 3))


proceed = jax.jit(asking.proceed)


@jax.jit
def begin(env: Environment, key: PRNGKeyArray) -> GuideState:
    """Return a guide without model and labels in the first situation of an episode."""
    return GuideState(None, None, None, None, *env.reset(key))  # pyright: ignore[reportArgumentType]


def replay(env: Environment, keys: SessionKeys, rows: Iterable[Any]) -> Iterator[GuideState]:
    """Replay recorded items; yield the situation before each item, and after the last.

    `rows` holds the items' observations and actions. The replay ends early, before the first item whose observation
    differs from the recorded one (a program of another version).
    """
    guide = begin(env, keys.start)
    for number, (obs, action) in enumerate(rows):
        if obs.shape != guide.obs.shape or not np.allclose(np.asarray(guide.obs), obs, atol=SAME):
            return
        yield guide
        guide = proceed(env, guide, jnp.asarray(action), asking.question_keys(keys.session, number))
    yield guide
