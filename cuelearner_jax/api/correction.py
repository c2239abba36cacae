"""Correct a policy by labels alone, without simulator or task; count how many other answers a policy agrees with."""

from __future__ import annotations

import dataclasses
import os
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cuelearner_jax import user_code
from cuelearner_jax.adaptation.by_model import plain_scalars
from cuelearner_jax.adaptation.judging import LABELS
from cuelearner_jax.api import arguments
from cuelearner_jax.api.adaptation import AdaptedPolicy, adapt
from cuelearner_jax.api.feedback import Labels, LabelSet, labels_from_file, labels_of, rows_of
from cuelearner_jax.api.policies import CallablePolicy, as_policy, load_policy
from cuelearner_jax.api.worlds import World
from cuelearner_jax.config import GuideSizes, Scalars, from_json
from cuelearner_jax.environment import Spaces
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback import external_labels
from cuelearner_jax.feedback.answers import RELATIVE
from cuelearner_jax.guides.reading import KIND
from cuelearner_jax.policies import in_space
from cuelearner_jax.policies.foreign import ONNX
from cuelearner_jax.spaces import Box, Choices, Space, cues_from
from cuelearner_jax.studies import agreement as study
from cuelearner_jax.studies.agreement import Agreement
from cuelearner_jax.tasks import logs
from cuelearner_jax.tasks.logs import LogsConfig


@user_code.report_user_errors
def correct(
    policy: Any,
    labels: Labels | str | os.PathLike[str],
    *,
    bound: float | None = None,
    eps: float | None = None,
    guidance: str = KIND.name,
    cues: str | Sequence[Any] = "",
    low: Sequence[float] | np.ndarray | None = None,
    high: Sequence[float] | np.ndarray | None = None,
    space: Space | None = None,
    changes: Any = None,
    sizes: GuideSizes | None = None,
    scalars: Scalars | None = None,
    seed: int = 0,
) -> AdaptedPolicy:
    """Correct a policy by relative labels, as `cuelearner adapt --labels-from` does, without a task.

    Every fifth answer is held out; a model that predicts fewer of these than "already right" always is not used, with a
    warning.

    Args:
        policy: the policy to correct: a function of a batch of observations, a module of PyTorch, a model of
            Stable-Baselines3, the path of a file in ONNX or of a folder of ours, or a policy.
        labels: `Labels(observations, actions, answers)` as arrays, or a label file.
        bound: how far corrections may lead from the policy's own actions, in the space's unit: shares of the range of
            each entry (default: as far as the labels reach).
        eps: strength of an answer, in the same unit (default: the file's, or 1/36 of the range).
        guidance: how answers are used: "reading" finds what changed, "relative" fits a network.
        cues: words for more and less of each entry of an action, "left,right;up,down" (default: "more,less").
        low, high: bounds of the actions, a number an entry (default: the range of the labels' actions).
        space: the space of the actions, such as `cuelearner_jax.spaces.DIRECTIONS`, in place of cues, low and high.
        changes: for guidance "reading", the possible changes, as for `adapt`.
        sizes, scalars: settings of the model and its fitting.
        seed: seed of all random numbers.

    Raises:
        UserError: labels or settings that cannot work, or with which the fit diverges.
    """
    if isinstance(policy, str | os.PathLike) and not str(policy).endswith(ONNX):
        policy = load_policy(policy)
    before = _recording_of(policy)
    arrays = not isinstance(labels, str | os.PathLike)
    if before is not None and arrays and not _chosen(space=space, cues=cues, low=low, high=high):
        space = logs.space_of(before)  # the labels of a policy that was corrected before
    found = _labels(labels, space, cues, low, high)
    own = as_policy(policy)
    CallablePolicy(in_space(own, found.space), actions=found.space)(found.rows.obs)  # refuses what gives no actions
    return adapt(
        policy if isinstance(policy, CallablePolicy) else own,
        world_of(found, before),
        labels=labels_of(found.rows),
        bound_deg=bound,
        eps_deg=found.strength(eps),
        guidance=guidance,
        sizes=sizes,
        scalars=scalars,
        seed=seed,
        judge_by=LABELS,
        changes=changes,
    )


@user_code.report_user_errors
def agreement(
    policy: Any,
    labels: Labels | str | os.PathLike[str],
    *,
    base: Any = None,
    eps: float | None = None,
    space: Space | None = None,
) -> Agreement:
    """Return how many answers a policy agrees with, beside its base and "already right" always.

    Args:
        policy: any policy that `correct` takes or returns.
        labels: answers that the policy was not corrected by, as `correct` takes them.
        base: the policy as it was (default: what a corrected policy corrects).
        eps: strength of an answer (default: the file's, the corrected policy's, or 1/36 of the range).
        space: space of the actions (default: the file's, or that of the corrected policy).

    Raises:
        UserError: labels that do not fit the policy, or no space.
    """
    own = as_policy(policy)
    if space is None and not isinstance(labels, str | os.PathLike):
        if not isinstance(policy, CallablePolicy):
            raise UserError("space is None, and arrays of labels name none: give space=, or a label file")
        space = policy.actions
    found = _labels(labels, space)
    eps = found.eps if eps is None else eps
    if eps is None:
        eps = float((getattr(own, "scalars", None) or plain_scalars(found.space)).eps_deg)
    base = getattr(own, "base", None) if base is None else as_policy(base)
    base = None if base is None else in_space(base, found.space)
    return study.agreement(in_space(own, found.space), found.rows, found.space, eps, base)


def _chosen(**values: Any) -> list[str]:
    """Return the names of the arguments that were given."""
    return [
        name for name, value in values.items() if not (value is None or (isinstance(value, str | tuple) and not value))
    ]


def _labels(labels: Any, space: Any, cues: Any = "", low: Any = None, high: Any = None) -> LabelSet:
    """Return checked labels with their space. Raises UserError for labels that do not fit it."""
    if isinstance(labels, str | os.PathLike):
        if chosen := _chosen(space=space, cues=cues, low=low, high=high):
            raise UserError(f"{labels} says its own space of actions: leave out {chosen[0]}")
        return labels_from_file(Path(labels))
    rows, note = rows_of(labels), partial(warnings.warn, stacklevel=5)
    if space is not None and (chosen := _chosen(cues=cues, low=low, high=high)):
        raise UserError(f"{chosen[0]} is given beside space, which says it already: leave out one of them")
    if space is None:
        low, high = (None if end is None else arguments.numbers("low and high", end).tolist() for end in (low, high))
        low, high = logs.bounds_of(np.asarray(rows.action), low, high, note=note)
        if not len(low) == len(high) == rows.action.shape[1]:
            raise UserError(f"low and high bound {len(low)} and {len(high)} entries: give {rows.action.shape[1]} each")
        space = Box(tuple(low), tuple(high), cues_from(cues) if _chosen(cues=cues) else ())
    external_labels.check(rows, Spaces(rows.obs.shape[1], space), RELATIVE)
    return LabelSet(rows, space)


def _recording_of(policy: Any) -> LogsConfig | None:
    """Return the digest of the recording by which a policy was corrected before; None: it was not."""
    config = getattr(getattr(policy, "trained", None), "task", None) if isinstance(policy, CallablePolicy) else None
    return config if isinstance(config, LogsConfig) else None


def world_of(found: LabelSet, before: LogsConfig | None = None) -> World:
    """Return the situations of labels as a world of the task `logs`, which names no folder.

    Networks of a policy that was corrected `before` keep their view. Raises UserError where that cannot be.
    """
    size, obs, space = found.rows.obs.shape[1], np.asarray(found.rows.obs), found.space
    own = {name: value for name, value in found.task.items() if name not in ("name", "from")}
    config = from_json(LogsConfig, own) if found.task.get("name") == logs.NAME else None
    if before is not None:
        if logs.space_of(before) != space:
            raise UserError(
                "the policy was corrected with other bounds or cues before: leave out cues, low, high and space"
            )
        config = before if sum(before.entries) == size else config
    if config is None or sum(config.entries) != size:
        centre, spread = logs.scales_of(obs)
        config = LogsConfig(entries=(size,), centre=centre, spread=spread)
    config = dataclasses.replace(config, path="", digest="", order="recorded", rows=len(obs))
    if logs.space_of(config) != space:
        cues = space.cues if isinstance(space, Box | Choices) else ()
        config = dataclasses.replace(
            config,
            actions=space.name,
            low=space.low if isinstance(space, Box) else (0.0,) * space.size,
            high=space.high if isinstance(space, Box) else (1.0,) * space.size,
            cues=tuple(",".join(cue.words) for cue in cues),
            cue_names=tuple(cue.name for cue in cues),
            keys=tuple(",".join(cue.keys) for cue in cues),
        )
    if logs.space_of(config).to_json() != space.to_json():
        raise UserError(f"the space {space.name!r} is not one that a recording can have: give a box with plain cues")
    filled = lambda config, split: logs.filled(config, obs, found.rows.action)  # noqa: E731
    return World(logs.configured(config, dataclasses.replace(logs.BODY, environment=filled)), config)
