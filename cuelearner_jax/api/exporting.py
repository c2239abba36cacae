"""Export from Python: what `cuelearner export` does, and exported decisions to call."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cuelearner_jax import user_code
from cuelearner_jax.api import arguments
from cuelearner_jax.api.acting import as_policy, as_policy_in
from cuelearner_jax.api.worlds import World, a_world
from cuelearner_jax.config import to_json
from cuelearner_jax.errors import UserError
from cuelearner_jax.export import contract, decisions, runner


@user_code.told
def export_policy(policy: Any, out: str | Path, world: World, format: str = "stablehlo") -> dict[str, Any]:
    """Writes a policy's whole decision as a file, with a contract of what goes in and what comes out.

    Args:
        policy: one that was loaded, adapted or refined, or anything else made of JAX functions that acts.
        out: a new folder.
        world: in which it acts: it names the slices of the observation, and golden cases are taken from it.
        format: "stablehlo", "onnx" or "numpy".

    Returns:
        The contract, with "difference": the largest one of a golden case in the file that was written.

    Raises:
        UserError: the folder is in use; the policy acts at random, asks a teacher, holds Python code, or does not fit.
    """
    out, _ = arguments.path("out", out), as_policy(policy)
    a_world("world", world)
    contract.check_request(arguments.text("format", format), out)
    env = world.env
    acting = as_policy_in(policy, env)
    about = {"subject": type(policy).__name__, "world": {"name": world.task.name, **to_json(world.config)}}
    drawn = lambda: decisions.observations(env, acting)  # noqa: E731
    return contract.write(acting, env, drawn, format, out, about)


def load_exported(folder: str | Path) -> runner.Decision:
    """An exported decision, its golden cases replayed: `decide(obs)` as a policy, `decide.contract`, `decide.check()`.

    Raises:
        UserError: the folder is damaged, or cannot be run here.
    """
    try:
        decide = runner.Decision(arguments.path("folder", folder))
        decide.check()
    except runner.ContractError as error:
        raise UserError(str(error)) from error
    return decide
