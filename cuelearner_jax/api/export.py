"""Export from Python: what `cuelearner export` does, and exported decisions to call."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cuelearner_jax import user_code
from cuelearner_jax.api.policies import as_policy, as_policy_in
from cuelearner_jax.api.worlds import World
from cuelearner_jax.config import to_json
from cuelearner_jax.errors import UserError
from cuelearner_jax.export import contract, correction, decisions, runner


@user_code.report_user_errors
def export_policy(
    policy: Any, out: str | Path, world: World | None = None, format: str = "stablehlo"
) -> dict[str, Any]:
    """Write a policy's whole decision as a file, with a contract of its inputs and outputs.

    Args:
        policy: one that was loaded, adapted or refined, or anything else made of JAX functions that acts.
        out: a new folder.
        world: the world that names the slices of the observation and supplies golden cases (default:
            where it was corrected).
        format: "stablehlo", "onnx" or "numpy".

    Returns:
        The contract, with "difference": the largest difference of the file's golden cases.

    Raises:
        UserError: the folder is in use; the policy acts at random, asks a teacher, holds Python code, or does not fit.
    """
    world, out = _world_of(policy, world), Path(out)
    contract.check_request(format, out)
    env = world.env
    acting = as_policy_in(policy, env)
    drawn = lambda: decisions.observations(env, acting)  # noqa: E731
    return contract.write(acting, env, drawn, format, out, _about(policy, world))


@user_code.report_user_errors
def export_correction(policy: Any, out: str | Path, world: World | None = None, format: str = "onnx") -> dict[str, Any]:
    """Write the correction of a corrected policy alone: observation and base action in, action out.

    It runs beside a base that stays where it is: `decide(observation, base_action)`. In ONNX its inputs are `obs` and
    `base_action`, its output `action`.

    Args:
        policy: a policy from `correct`, `adapt` or `refine`, or loaded from a policy folder.
        out: a new folder.
        world: the world that the policy acts in (default: where it was corrected).
        format: "onnx", "numpy" or "stablehlo".

    Returns:
        The contract, as `export_policy` does.

    Raises:
        UserError: the folder is in use; the policy corrects nothing, or cannot do it without its base.
    """
    world, out = _world_of(policy, world), Path(out)
    contract.check_request(format, out)
    alone, seen = correction.correction_of(as_policy(policy), world.env)
    return contract.write(alone, seen, lambda: correction.cases(world.env), format, out, _about(policy, world))


def _world_of(policy: Any, world: World | None) -> World:
    """Return where a policy acts. Raises UserError if it is not known."""
    world = world or getattr(policy, "world", None)
    if world is None:
        raise UserError("world is None, and this policy names none: give world=cl.make(...)")
    return world


def _about(policy: Any, world: World) -> dict[str, Any]:
    return {"subject": type(policy).__name__, "world": {"name": world.task.name, **to_json(world.config)}}


def load_exported(folder: str | Path) -> runner.Decision:
    """Return an exported decision whose golden cases were replayed: call it as `decide(obs)`.

    `decide.contract` is its contract, `decide.check()` replays the golden cases again.

    Raises:
        UserError: the folder is damaged, or cannot be run here.
    """
    try:
        decide = runner.Decision(Path(folder))
        decide.check()
    except runner.ContractError as error:
        raise UserError(str(error)) from error
    return decide
