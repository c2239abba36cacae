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

if TYPE_CHECKING:
    from cuelearner_jax.api.adaptation import AdaptedPolicy, adapt, agreement, correct
    from cuelearner_jax.api.labels import Labels
    from cuelearner_jax.api.policies import (
        CallablePolicy,
        export_correction,
        export_policy,
        load_exported,
        load_policy,
        measure,
    )
    from cuelearner_jax.api.training import Run, read_run, train
    from cuelearner_jax.api.worlds import World, from_gymnasium, make, teacher_of
    from cuelearner_jax.errors import UserError
    from cuelearner_jax.reading import Distortion, Unknown
    from cuelearner_jax.spaces import UNSAID

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

__all__ = [
    "UNSAID",
    "AdaptedPolicy",
    "CallablePolicy",
    "Distortion",
    "Labels",
    "Run",
    "Unknown",
    "UserError",
    "World",
    "adapt",
    "agreement",
    "correct",
    "export_correction",
    "export_policy",
    "from_gymnasium",
    "load_exported",
    "load_policy",
    "make",
    "measure",
    "read_run",
    "teacher_of",
    "train",
]


def __getattr__(name: str) -> Any:
    """Return a public name, whose module is loaded at first use."""
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted([*__all__, "__version__"])
