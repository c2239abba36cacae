"""Write and open policy folders, the output of `cuelearner adapt`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_jax import config as configuration
from cuelearner_jax.adaptation import serialization
from cuelearner_jax.adaptation.by_model import AdaptationResult, reach
from cuelearner_jax.adaptation.judging import SPLIT
from cuelearner_jax.adaptation.lanes import Lanes
from cuelearner_jax.environment import actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback.answers import AnswerForm
from cuelearner_jax.policies import Common, lanes_in, layers
from cuelearner_jax.runs.grid import world_of
from cuelearner_jax.storage import formats, label_files, policy_folders
from cuelearner_jax.storage.checkpoint import Checkpoints, digest
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.storage.table import plain
from cuelearner_jax.storage.whole import Place
from cuelearner_jax.task import Task, shape_of
from cuelearner_jax.types import Label

COLUMNS = ("base", "seeds", "labels", "bounds_deg", "used")  # that describe the lanes
GOLDEN, SAME = 8, 1e-3  # observations whose actions by code a folder keeps, and how near they must come, as a share
CONVENTIONS = {
    "action": "the base policy's, refined by the model until a pass moves it by less than tau, within the bound; or, "
    "read, of the observation as it was before the changes, led back to what it meant",
    "angles": "degrees where a name ends in _deg, else radians; counterclockwise positive",
}


@dataclass(frozen=True)
class AdaptedLanes:
    """The lanes of a policy folder."""

    folder: Path
    values: dict[str, Any]  # the contents of policy.json
    lanes: Lanes
    in_use: np.ndarray  # (lanes,) bool
    rows: int | None  # number of base policies, one per lane; None: the lanes share one
    code: Any  # the policy that the folder names as code; None: not given
    changes: Any = None  # the user's own distortions, as `changes.family_of` takes them; None: not given

    @property
    def guidance(self) -> str:
        """The kind of guidance that was fitted last."""
        return self.values["policy"]["guidance"]

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of guidance that refine the policy, the last one first."""
        return tuple(layer["guidance"] for layer in layers(self.values["policy"]) if "guidance" in layer)

    @property
    def bounds_deg(self) -> np.ndarray:
        """Largest distance from the adapted policy's actions per lane, in the space's unit; 0: no bound."""
        return self.lanes.bound_deg * bool(self.values["policy"].get("bounded"))

    def policy(self, env: Any) -> Any:
        """Return a block of the lanes' policies. Raises UserError if they cannot be read."""
        policy = serialization.from_json(self.values["policy"], env, self.code, self.changes)
        like = _with_rows(serialization.arrays_of(policy), self.lanes.number)
        like["base"] = _with_rows(serialization.arrays_of(policy.base), self.rows)
        place, remedy = self.folder / policy_folders.ARRAYS, "restore it, or adapt the policy anew"
        if not place.is_dir():
            raise UserError(f"{place} is missing: {remedy}")
        with Checkpoints(place, read_only=True, remedy=remedy) as store:
            arrays = store.restore({"policy": like})["policy"]
        if digest(arrays) != self.values.get("arrays"):
            raise UserError(f"{place} holds the arrays of another policy: {remedy}")
        policy = serialization.with_arrays(policy, arrays)
        golden, space = self.values.get("base_acts"), actions_of(env)
        if golden and reach(space, policy.base, **golden) > SAME * space.reach:
            *_, code = layers(self.values["policy"])
            raise UserError(f"{self.folder} corrects {code['named']}, but the base given acts otherwise: give that one")
        return policy.replace(base=Common(policy.base) if self.rows is None else policy.base.lane(self.lanes.base))


def _with_rows(arrays: Any, rows: int | None) -> Any:
    """Return the shapes of arrays that have a row for each of several policies; None: one policy."""
    leading = () if rows is None else (rows,)
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((*leading, *leaf.shape), leaf.dtype), arrays)


def open_folder(
    folder: Path, find: Callable[[str], Task], code: Any = None, changes: Any = None
) -> tuple[Task, Any, AdaptedLanes]:
    """Open a policy folder; return its task, world (a configuration) and lanes.

    `find`: see `grid.load`. `code`, `changes`: what the folder names as code, and the user's own distortions in it, as
    `changes.family_of` takes them; None: not given.
    """
    path = folder / policy_folders.POLICY
    values = formats.read("policy", path)
    task, world = world_of(values["task"], find, path)
    *columns, in_use = (np.array(values["lanes"][name]) for name in COLUMNS)
    lanes = AdaptedLanes(folder, values, Lanes(*columns), in_use, values["rows"], code, changes)
    return task.on(values.get("robot")), world, lanes


def write(
    place: Place, result: AdaptationResult, task: Task, world: Any, origin: dict[str, Any], more: dict[str, str | None]
) -> None:
    """Write a policy folder of lanes that were adapted in a task's world.

    `origin`: the base policies in plain values: "folder" and which lanes of it, or "code". `more`: the label file and
    another robot, by name.
    """
    lanes, judgement, env = result.lanes, result.judgement, shape_of(task, world)
    block = replace(result.policy(env), base=result.of.bases)
    values, arrays = serialization.to_json(block, origin.get("code")), serialization.arrays_of(block)
    golden, (*_, last) = {}, layers(values)
    if last["policy"] == "code" and lanes_in(result.of.bases) is None:  # not in the folder, but told from other code
        obs = jnp.asarray(result.labels.obs[0, : min(GOLDEN, lanes.budget[0])])
        golden = {"base_acts": {"obs": obs.tolist(), "action": block.base.act(jax.random.key(0), None, obs).tolist()}}
    contents = {
        "task": {"name": task.name, **({"from": task.origin} if task.origin else {}), **configuration.to_json(world)},
        **({"files": files} if (files := task.files(world)) else {}),
        "of": origin,
        "policy": values,
        "rows": lanes_in(result.of.bases),
        "lanes": {
            "base": lanes.base.tolist(),
            "seeds": lanes.seed.tolist(),
            "labels": lanes.budget.tolist(),
            "bounds_deg": [float(f"{bound:g}") for bound in lanes.bound_deg],
            "used": judgement.in_use.tolist(),
        },
        "judged": {
            "by": judgement.by,
            "split": SPLIT,
            "before": plain(judgement.before.tolist()),
            "after": plain(judgement.after.tolist()),
            "within_deg": [float(f"{bound:g}") for bound in judgement.within_deg],
            "difference": plain(judgement.difference.tolist()),
            "rewarded_steps": judgement.rewarded_steps.tolist(),
        },
        **({"reading": [one.to_json() for one in result.results]} if result.results else {}),
        **{name: value for name, value in more.items() if value},
        **golden,
        "observation": [quantity._asdict() for quantity in env.observation],
        "conventions": CONVENTIONS,
        **provenance(),
    }
    with place() as folder:
        with Checkpoints(folder / policy_folders.ARRAYS) as store:
            store.save(0, {"policy": arrays})
        formats.write("policy", folder / policy_folders.POLICY, {**contents, "arrays": digest(arrays)})
        _write_labels(folder, result, task, world)


def _write_labels(folder: Path, result: AdaptationResult, task: Task, world: Any) -> None:
    """Write one label file per bound: each seed's largest set, which starts with the smaller ones but in readings."""
    of, lanes = result.of, result.lanes
    form: AnswerForm | None = of.guidance.form
    assert form is not None
    head, space = {"name": task.name, **configuration.to_json(world)}, actions_of(of.env)
    eps, largest = of.scalars.eps_deg if form.by_eps else None, lanes.budget == lanes.budget.max()
    for bound in (bounds := np.unique(lanes.bound_deg)):
        own = np.flatnonzero(largest & (lanes.bound_deg == bound))
        sets: Label = jax.tree.map(lambda leaf, own=own: leaf[own], result.labels)
        file = folder / (label_files.PARQUET if len(bounds) == 1 else f"labels-{bound:g}deg.parquet")
        label_files.write(file, head, form.name, space, eps, lanes.seed[own], sets, meaning=form.meaning(space))
