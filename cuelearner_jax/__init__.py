"""CueLearner in JAX: learning from relative feedback combined with off-policy deep RL (arXiv 2507.04730).

    import cuelearner_jax as cl

    world = cl.make("navigation", style="rooms")           # a task in one configuration
    teacher = cl.teacher_of(world)                          # who answers "more to the left", "already right", ...
    policy = cl.load_policy("shipped:navigation")           # policy(obs) -> action, of one or many observations
    better = cl.adapt(policy, world, teacher, labels=300)   # answers in rounds, a model of them, a policy again
    cl.measure(better, world, episodes=200).metrics         # on validation episodes, by name
    better.save("policies/better")                          # a folder that load_policy and every command take
    cl.export_policy(better, "walker", world, "numpy")      # a file that runs without JAX, and its contract
    run = cl.train(world, teacher, "quickstart", seeds=8)   # what `cuelearner sweep` does, results in memory
    table = cl.read_run("runs/study")                       # recorded results as one table (Arrow)
    arm = cl.from_gymnasium("FetchReach-v4")                # a world as well: any Gymnasium environment

Arguments and results are described in each function's docstring. Parts of your own import from the public modules,
which docs/reference/interfaces.md lists. All other modules are internal.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

# Of SciPy's BLAS, by which JAX factorizes matrices on a CPU: its threads wait for each other longer than they compute.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

if TYPE_CHECKING:  # each by its own name, which tells type checkers that it is public
    from cuelearner_jax.api.adaptation import AdaptedPolicy as AdaptedPolicy
    from cuelearner_jax.api.adaptation import adapt as adapt
    from cuelearner_jax.api.adaptation import agreement as agreement
    from cuelearner_jax.api.adaptation import correct as correct
    from cuelearner_jax.api.labels import Labels as Labels
    from cuelearner_jax.api.policies import CallablePolicy as CallablePolicy
    from cuelearner_jax.api.policies import export_correction as export_correction
    from cuelearner_jax.api.policies import export_policy as export_policy
    from cuelearner_jax.api.policies import load_exported as load_exported
    from cuelearner_jax.api.policies import load_policy as load_policy
    from cuelearner_jax.api.policies import measure as measure
    from cuelearner_jax.api.training import Run as Run
    from cuelearner_jax.api.training import read_run as read_run
    from cuelearner_jax.api.training import train as train
    from cuelearner_jax.api.worlds import World as World
    from cuelearner_jax.api.worlds import from_gymnasium as from_gymnasium
    from cuelearner_jax.api.worlds import make as make
    from cuelearner_jax.api.worlds import teacher_of as teacher_of
    from cuelearner_jax.errors import UserError as UserError
    from cuelearner_jax.reading import Distortion as Distortion
    from cuelearner_jax.reading import Unknown as Unknown
    from cuelearner_jax.spaces import UNSAID as UNSAID

__version__ = "1.0.0"

# The names of each module, loaded at first use: tasks import only the lowest modules of this package, and each command
# needs few modules.
_NAMES = {
    "api.adaptation": ("AdaptedPolicy", "adapt", "agreement", "correct"),
    "api.labels": ("Labels",),
    "api.policies": ("CallablePolicy", "load_policy", "measure", "load_exported", "export_policy", "export_correction"),
    "api.training": ("Run", "read_run", "train"),
    "api.worlds": ("World", "from_gymnasium", "make", "teacher_of"),
    "errors": ("UserError",),
    "reading": ("Distortion", "Unknown"),
    "spaces": ("UNSAID",),
}
_PLACES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = [*_PLACES]  # noqa: PLE0604  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
