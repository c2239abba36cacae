"""Policies to call, on one observation or on many: loaded, measured and exported."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax import user_code
from cuelearner_jax.api.worlds import World, numbers
from cuelearner_jax.config import to_json
from cuelearner_jax.environment import Quantity, actions_of, check_layout
from cuelearner_jax.errors import UserError
from cuelearner_jax.policies import FILES, Policy, call_policy, policy_name, policy_of
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs import policy_sources
from cuelearner_jax.runs.policy_sources import LaneChoice
from cuelearner_jax.spaces import DIRECTIONS, Space
from cuelearner_jax.studies import evaluate
from cuelearner_jax.studies.evaluate import EvaluateRequest, Measured
from cuelearner_jax.task import Task, shape_of
from cuelearner_jax.tasks import registry, shipped
from cuelearner_jax.types import EnvState


@partial(jax.jit, static_argnames="space")
def _act(policy: Policy, key: PRNGKeyArray, obs: Float[Array, "n obs"], space: Space) -> Float[Array, "n action"]:
    return call_policy(policy, key, None, obs, space)


@dataclasses.dataclass(frozen=True, repr=False)
class CallablePolicy:
    """A policy that can be called: `policy(obs)` on an observation (obs,), or on a batch (n, obs).

    `policy.policy` is the pytree behind it, `policy.act(key, states, obs)` what evaluation calls.
    """

    policy: Policy
    observation: tuple[Quantity, ...] = ()  # slices of the observation; empty: not known
    asks: bool = False  # True if the policy asks a teacher, who looks at the true state
    trained: RunConfig | None = None  # configuration of its training; None: not known
    actions: Space = DIRECTIONS  # space of its actions
    world: World | None = None  # world in which it was corrected, or loaded for; None: not known
    lane: dict[str, Any] = dataclasses.field(default_factory=dict)  # what chooses its lane; empty: not of a folder

    def __post_init__(self) -> None:
        """Make a policy of an object that acts. Raises UserError for any other."""
        object.__setattr__(self, "policy", policy_of(self.policy, self.actions))

    def __repr__(self) -> str:
        sizes = f"obs ({sum(quantity.size for quantity in self.observation) or '?'},) -> action ({self.actions.size},)"
        where = [self.world.task.name] if self.world else []
        where += [f"{name}={value!r}" for name, value in self.lane.items()]
        words = ", ".join([policy_name(self.policy).removeprefix("policy "), sizes, *where])
        return f"{type(self).__name__}({words})"

    @user_code.report_user_errors
    def __call__(self, obs: Any, key: PRNGKeyArray | None = None) -> np.ndarray:
        """Return actions (action,) or (n, action); of directions unit vectors.

        Args:
            obs: (obs,) or (n, obs), as `observation` orders them.
            key: for a policy that acts at random (default: always the same).
        """
        if self.asks:
            raise UserError("this policy asks a teacher, who looks at the true state: call its act(key, states, obs)")
        rows = numbers("obs", obs)
        width = sum(quantity.size for quantity in self.observation) or (rows.shape[-1:] and rows.shape[-1])
        if rows.ndim not in (1, 2) or rows.shape[-1] != width or not width:
            raise UserError(f"obs: observations have shape {rows.shape}: give ({width},) or (n, {width})")
        key = jax.random.key(0) if key is None else key
        # a copy, which the caller may write in
        result = np.array(_act(self.policy, key, jnp.asarray(np.atleast_2d(rows)), self.actions))
        user_code.check_actions(result, policy_name(self.policy))
        return result[0] if rows.ndim == 1 else result

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Act as `types.Policy.act`."""
        return self.policy.act(key, states, obs)


def as_policy(source: Any) -> Policy:
    """Return a policy of a `CallablePolicy`, of a policy folder, or of anything that `policies.policy_of` takes."""
    if isinstance(source, str | os.PathLike) and not str(source).endswith(FILES):
        source = load_policy(source)
    return source.policy if isinstance(source, CallablePolicy) else policy_of(source)


def as_policy_in(source: Any, env: Any) -> Policy:
    """Return `as_policy` for a world. Raises UserError for a policy of other observations or actions."""
    policy = policy_of(as_policy(source), actions_of(env))
    if isinstance(source, CallablePolicy) and source.observation:
        check_layout("the policy", source.observation, source.actions, env)
    return policy


def config_of(policy: Any, world: World) -> RunConfig:
    """Return the configuration of a policy's training, or a stand-in, in a world."""
    return dataclasses.replace(getattr(policy, "trained", None) or world.task.start(), task=world.config)


@user_code.report_user_errors
def load_policy(
    folder: str | os.PathLike[str],
    *,
    policy: str | None = None,
    guidance: str | None = None,
    labels: int | None = None,
    bound_deg: float | None = None,
    seed: int | None = None,
    base: Any = None,
    changes: Any = None,
    task: Task | str | None = None,
    world: World | None = None,
) -> CallablePolicy:
    """Load the policy of a lane of a finished run, or of a policy folder (`adapt`).

    Args:
        folder: folder of a run, of a sweep in pieces, or of a policy; or a shipped agent, as "shipped:navigation".
        policy: "agent", "guided" or another that `evaluate TASK --help` lists (default: trained agent, adapted policy).
        guidance, labels, seed: of the lane (default: of a run the lane with the best last reward, which is printed; of
            a policy folder the largest budget and the first seed).
        bound_deg: bound [deg] of a lane of a policy folder (default: the largest).
        base, changes: code of the adapted policy, and distortions of your own, which a folder names and does not hold.
        task: of a run of a task from outside the package, whose code is not loaded because a file names it.
        world: the world to act in, for policies that need more than observations (default: as it was trained).
    """
    path = shipped.folder_of(os.fspath(folder))
    if not path.exists():
        raise UserError(f"folder {path} does not exist: give the folder of a run, or of an adapted policy")
    own = registry.resolve(task) if isinstance(task, str) else task
    find = lambda name: own if own and own.name == name else registry.find(name)  # noqa: E731
    source = policy_sources.PolicySource.of_folder(path, find, None if base is None else as_policy(base), changes)
    where, name = world or World(source.task, source.config.task), policy or source.default_policy
    source.check(name, where.config)
    shape, seeds = shape_of(source.task, where.config), () if seed is None else (seed,)
    choice = LaneChoice(policy=name, guidance=guidance, labels=labels, bound_deg=bound_deg, seed=seeds)
    acting, lane = choice.lane_in(source, where.config)
    taught = policy_sources.POLICIES[name].taught
    return CallablePolicy(acting, shape.observation, taught, source.config, actions_of(shape), where, lane)


@user_code.report_user_errors
def measure(
    policy: Any,
    world: World,
    *,
    episodes: int | None = None,
    steps: int | None = None,
    envs: int | None = None,
    engine: str | None = None,
) -> Measured:
    """Measure a policy on validation episodes of a world: the numbers of `cuelearner evaluate`.

    Args:
        policy: a policy, or any function of a batch of observations in NumPy.
        world: the world that the policy acts in.
        episodes: whole episodes, where the task counts episodes (default: 100).
        steps, envs: environment steps in place of episodes, and the environments that share them (default, where the
            task counts steps: 10,000 and 100).
        engine: other physics that the world's robot has (default: its own).

    Returns:
        `metrics`: the mean (1,) of each metric by name; `each`: the environments' values (1, envs) of each metric.
    """
    code, name = as_policy_in(policy, world.env), Path(world.task.name)
    source = policy_sources.PolicySource(world.task, config_of(policy, world), None, name, code=code)
    request = EvaluateRequest(task=world.config, policy="own", episodes=episodes, steps=steps, envs=envs, engine=engine)
    (measured,) = evaluate.run(source, request)
    return measured


@user_code.report_user_errors
def export_policy(
    policy: Any, out: str | Path, world: World | None = None, format: str = "stablehlo"
) -> dict[str, Any]:
    """Write a policy's whole decision as a file, with a contract of its inputs and outputs.

    Args:
        policy: one that was loaded or adapted, or anything else made of JAX functions that acts.
        out: a new folder.
        world: names the slices of the observation and supplies golden cases (default: where it was corrected).
        format: "stablehlo", "onnx" or "numpy".

    Returns:
        The contract, with "difference": the largest difference of the file's golden cases.
    """
    from cuelearner_jax.export import decisions  # only exports need it

    def whole(env: Any) -> tuple[Policy, Any, Callable[[], np.ndarray]]:
        acting = as_policy_in(policy, env)
        return acting, env, lambda: decisions.observations(env, acting)

    return _export(policy, out, world, format, whole)


@user_code.report_user_errors
def export_correction(policy: Any, out: str | Path, world: World | None = None, format: str = "onnx") -> dict[str, Any]:
    """Write the correction of a corrected policy alone: observation and base action in, action out.

    It runs beside a base that stays where it is: `decide(obs, *map(base, decide.base_observations(obs)))`. In ONNX its
    inputs are `obs` and `base_action`, its outputs `action` and, if the correction changes what the base sees,
    `base_obs`. `policy`: from `correct` or `adapt`, or loaded from a policy folder. The rest is as in `export_policy`.
    """
    from cuelearner_jax.export import correction

    return _export(policy, out, world, format, partial(correction.correction_of, as_policy(policy)))


def _export(policy: Any, out: str | Path, world: World | None, format: str, part: Callable[[Any], Any]) -> Any:
    """Write a part of a policy; `part`: environment -> policy, its interface, and observations for golden cases."""
    from cuelearner_jax.export import contract

    if (world := world or getattr(policy, "world", None)) is None:
        raise UserError("world is None, and this policy names none: give world=cl.make(...)")
    contract.check_request(format, Path(out))
    lane = policy.lane if isinstance(policy, CallablePolicy) else {}
    about = {"subject": type(policy).__name__, **lane, "world": {"name": world.task.name, **to_json(world.config)}}
    alone, interface, draw = part(world.env)
    return contract.write(alone, interface, draw, format, Path(out), about)


def load_exported(folder: str | Path) -> Any:
    """Return an exported decision whose golden cases were replayed: call it as `decide(obs)`.

    `decide.contract` is its contract, `decide.check()` replays the golden cases again.
    """
    from cuelearner_jax.export import contract

    return contract.open_decision(Path(folder))[0]
