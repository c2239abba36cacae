"""Correct a policy by labels alone, without simulator or task; count how many other answers a policy agrees with."""

from __future__ import annotations

import dataclasses
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from cuelearner_jax import config as configuration
from cuelearner_jax import user_code
from cuelearner_jax.adaptation.by_model import plain_scalars
from cuelearner_jax.adaptation.judging import LABELS
from cuelearner_jax.api import arguments
from cuelearner_jax.api.adaptation import AdaptedPolicy, adapt
from cuelearner_jax.api.feedback import Labels, label_path, labels_of, rows_of
from cuelearner_jax.api.policies import CallablePolicy, as_policy, load_policy
from cuelearner_jax.api.worlds import World
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.environment import Spaces
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback import external_labels
from cuelearner_jax.feedback.answers import RELATIVE
from cuelearner_jax.guides.reading import KIND
from cuelearner_jax.policies import policy_of
from cuelearner_jax.policies.foreign import ONNX
from cuelearner_jax.spaces import Box, Choices, Space, cues_from
from cuelearner_jax.storage import label_files
from cuelearner_jax.studies import agreement as study
from cuelearner_jax.studies.agreement import Agreement
from cuelearner_jax.tasks import logs
from cuelearner_jax.tasks.logs import LogsConfig
from cuelearner_jax.types import Label


class GivenLabels(NamedTuple):
    """Labels with the strength, space and recording that their file names."""

    rows: Label
    space: Space
    eps: float | None  # strength of an answer in the space's unit; None: not known
    config: LogsConfig | None = None  # digest of the recording that the labels are about; None: not known


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
        UserError: labels or settings that make no sense, or with which the fit diverges.
    """
    if policy is None:
        raise UserError(
            "policy is None: give the policy whose actions the labels are about; without a base policy, "
            "cl.fit_feedback fits a model to the answers"
        )
    policy = (
        load_policy(os.fspath(policy))
        if isinstance(policy, str | os.PathLike) and not str(policy).endswith(ONNX)
        else policy
    )
    before = _recording_of(policy)
    if (
        before is not None
        and not isinstance(labels, str | os.PathLike)
        and not any(map(_is_told, (space, cues, low, high)))
    ):
        space = logs.space_of(before)  # the labels of a policy that was corrected before
    found = _given(labels, space, cues, low, high)
    eps = arguments.optional(arguments.amount, "eps", eps, found.space)
    if found.eps is not None and eps is not None and not np.isclose(eps, found.eps, rtol=1e-6):
        raise UserError(f"{labels} holds answers of {found.eps:g} {found.space.unit}: leave out eps")
    world = world_of(found, before)
    own = as_policy(policy)
    # raises UserError where the policy returns something else than actions
    CallablePolicy(policy_of(own, found.space), actions=found.space)(found.rows.obs)
    return adapt(
        policy if isinstance(policy, CallablePolicy) else own,
        world,
        labels=labels_of(found.rows),
        bound_deg=arguments.optional(arguments.amount, "bound", bound, found.space),
        eps_deg=found.eps if eps is None else eps,
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
    if space is None and isinstance(policy, CallablePolicy) and not isinstance(labels, str | os.PathLike):
        space = policy.actions
    if space is None and not isinstance(labels, str | os.PathLike):
        raise UserError("space is None, and arrays of labels name none: give space=, or a label file")
    found = _given(labels, space, "", None, None)
    strength = arguments.optional(arguments.amount, "eps", eps, found.space) or found.eps
    if strength is None:
        scalars = getattr(own, "scalars", None) or plain_scalars(found.space)
        strength = float(scalars.eps_deg)
    base = getattr(own, "base", None) if base is None else as_policy(base, "base")
    base = None if base is None else policy_of(base, found.space)
    return study.agreement(policy_of(own, found.space), found.rows, found.space, strength, base)


def _given(labels: Any, space: Any, cues: Any, low: Any, high: Any) -> GivenLabels:
    """Return checked labels with their space. Raises UserError for labels that make no sense."""
    told = [name for name, value in (("cues", cues), ("low", low), ("high", high)) if _is_told(value)]
    if space is not None and told:
        raise UserError(f"{told[0]} is given beside space, which says it already: leave out one of them")
    arguments.optional(arguments.instance, "space", space, Space, "a space of actions")
    if isinstance(labels, str | os.PathLike):
        if told or space is not None:
            raise UserError(f"{labels} says its own space of actions: leave out {told[0] if told else 'space'}")
        return labels_from_file(label_path(labels))
    rows = rows_of(labels)
    if space is None:
        size = rows.action.shape[1]
        low, high = arguments.optional(_numbers, "low", low), arguments.optional(_numbers, "high", high)
        low, high = logs.bounds_of(
            np.asarray(rows.action), low, high, note=lambda line: warnings.warn(line, stacklevel=5)
        )
        if len(low) != size or len(high) != size:
            raise UserError(
                f"low and high bound {len(low)} and {len(high)} entries, actions have {size}: give one an entry"
            )
        space = Box(tuple(map(float, low)), tuple(map(float, high)), cues_from(cues) if _is_told(cues) else ())
    external_labels.check(rows, Spaces(rows.obs.shape[1], space), RELATIVE)
    return GivenLabels(rows, space, None)


def _is_told(value: Any) -> bool:
    return value is not None and not (isinstance(value, str | tuple | list) and not value)


def _numbers(name: str, value: Any) -> list[float]:
    return arguments.numbers(name, value).reshape(-1).tolist()


def labels_from_file(path: Path) -> GivenLabels:
    """Return the labels of a file's first seed. Raises UserError for a file of other answers."""
    file = label_files.read(path)
    if file.answers != RELATIVE.name:
        raise UserError(f"{path} holds {file.answers} answers: give a file of {RELATIVE.name} ones")
    external_labels.check_file(file, None, RELATIVE, str(path))
    own = file.seeds == file.seeds[0]
    rows = jax.tree.map(lambda leaf: np.asarray(leaf)[own], file.labels)
    config = None
    if file.task.get("name") == logs.NAME:
        values = {name: value for name, value in file.task.items() if name not in ("name", "from")}
        try:
            config = configuration.from_json(LogsConfig, values)
        except UserError as error:
            raise UserError(f"{path} does not name the situations of its labels: write the file again") from error
    return GivenLabels(rows, file.space, file.eps, config)


def _recording_of(policy: Any) -> LogsConfig | None:
    """Return the digest of the recording by which a policy was corrected before; None: it was not."""
    config = getattr(getattr(policy, "trained", None), "task", None) if isinstance(policy, CallablePolicy) else None
    return config if isinstance(config, LogsConfig) else None


def world_of(found: GivenLabels, before: LogsConfig | None = None) -> World:
    """Return the situations of labels as a world of the task `logs`, which names no folder.

    Networks of a policy that was corrected `before` keep their view. Raises UserError where that cannot be.
    """
    config, size = found.config, found.rows.obs.shape[1]
    if config is None or sum(config.entries) != size:
        centre, spread = logs.scales_of(np.asarray(found.rows.obs))
        config = LogsConfig(entries=(size,), centre=centre, spread=spread)
    if before is not None:
        if logs.space_of(before) != found.space:
            raise UserError(
                "the policy was corrected with other bounds or cues before: leave out cues, low, high and space"
            )
        config = before if sum(before.entries) == size else config
    values = {} if logs.space_of(config) == found.space else _as_values(found.space)
    plain = {"path": "", "digest": "", "order": "recorded", "rows": len(found.rows.obs)}
    config = dataclasses.replace(config, **plain, **values)
    if logs.space_of(config).to_json() != found.space.to_json():
        raise UserError(
            f"the space {found.space.name!r} is not one that a recording can have: give a box with plain cues"
        )
    filled = lambda config, split: logs.filled(config, found.rows.obs, found.rows.action)  # noqa: E731
    return World(logs.configured(config, dataclasses.replace(logs.BODY, environment=filled)), config)


def _as_values(space: Space) -> dict[str, Any]:
    """Return a space as the fields of a configuration."""
    bounds = {"low": (0.0,) * space.size, "high": (1.0,) * space.size}
    if isinstance(space, Box):
        bounds = {"low": space.low, "high": space.high}
    own = [] if not isinstance(space, Box | Choices) else space.cues
    return {
        "actions": space.name,
        **bounds,
        "cues": tuple(",".join(cue.words) for cue in own),
        "cue_names": tuple(cue.name for cue in own),
        "keys": tuple(",".join(cue.keys) for cue in own),
    }
