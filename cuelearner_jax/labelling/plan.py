"""What a session of labelling is about."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from cuelearner_jax.calibration.families import Family
from cuelearner_jax.config import to_json
from cuelearner_jax.feedback.forms import AnswerForm
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.policies import Policy
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.task import Task

APART = ("env", "teacher")  # fields of policies that are the world's, which the file tells by itself


@dataclass(frozen=True)
class Base:
    """The policy whose actions are asked about."""

    policy: Policy
    name: str

    @property
    def digest(self) -> str:
        """Short hash of its parameters; empty where it has none that JAX knows of."""
        found = hashlib.sha256()
        count = 0
        for path, leaf in jax.tree_util.tree_leaves_with_path(self.policy):
            if any(getattr(part, "name", "") in APART for part in path):
                continue
            array = np.asarray(leaf)
            found.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
            count += 1
        return found.hexdigest()[:12] if count else ""


@dataclass(frozen=True)
class Plan:
    """Who is asked about what, and how much."""

    task: Task
    config: RunConfig  # of which the world, the sizes and the scalars count
    guidance: Guide
    base: Base
    labels: int  # answers that are wanted
    seed: int = 0
    who: str = "anonymous"
    bound_deg: float | None = None  # of questions' way from the base's actions, in the space's unit; None: anywhere
    robot: str = ""  # its body and what that walks by, where it is not the task's own
    again: tuple[np.ndarray, ...] = ()  # actions that another session of this seed asked about: they are asked again
    again_of: str = ""  # digest of its file
    family: Family = ()  # of calibration: what may have changed
    one_cue: bool = False  # of several cues, is one press, about one of them, the whole answer?

    @property
    def form(self) -> AnswerForm:
        """Of the answers."""
        assert self.guidance.form is not None
        return self.guidance.form

    @property
    def world(self) -> dict[str, Any]:
        """The task and its configuration, as label files name them."""
        return {"name": self.task.name, **to_json(self.config.task)}

    @property
    def eps(self) -> float | None:
        """Strength of an answer in the space's unit, where the form has one."""
        return self.config.scalars.eps_deg if self.form.by_eps else None

    def session(self, env: Any) -> dict[str, Any]:
        """What else must be the same for answers to share a file."""
        layout = [{"name": part.name, "size": part.size, "unit": part.unit} for part in env.observation]
        return {
            "seed": self.seed,
            "guidance": self.guidance.name,
            "base": self.base.name,
            "base_digest": self.base.digest,
            "bound": self.bound_deg,
            **({"robot": self.robot} if self.robot else {}),
            **({"again_of": self.again_of} if self.again else {}),
            "observation": layout,
        }
