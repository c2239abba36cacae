"""CueLearner in JAX: learning from relative feedback combined with off-policy deep RL (arXiv 2507.04730).

    import cuelearner_jax as cl

    world = cl.make("navigation", style="rooms")           # a task in one configuration
    teacher = cl.teacher_of(world)                          # who answers "more to the left", "already right", ...
    policy = cl.load_policy("docs/data/navigation_agent")   # policy(obs) -> action, of one or many observations
    better = cl.adapt(policy, world, teacher, labels=300)   # answers in rounds, a model of them, a policy again
    better.save("policies/better")                          # a folder that load_policy and every command take
    cl.export_policy(better, "walker", world, "numpy")      # a file that runs without JAX, and its contract
    run = cl.train(world, teacher, "quickstart", seeds=8)   # what `cuelearner sweep` does, results in memory

What these take and give stands in their docstrings. Everything else is a room behind this face.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cuelearner_jax.errors import UserError
    from cuelearner_jax.face.acting import CallablePolicy, load_policy
    from cuelearner_jax.face.adaptation import AdaptedPolicy, adapt
    from cuelearner_jax.face.exporting import export_policy, load_exported
    from cuelearner_jax.face.feedback import FeedbackModel, Labels, ask, fit_feedback, refine
    from cuelearner_jax.face.training import Run, train
    from cuelearner_jax.face.worlds import World, make, teacher_of

__version__ = "0.1.0"

# Where each name lies. They are loaded when they are first used: tasks import the bottom rooms of this package, and the
# command line needs little of it at a time.
_PLACES = {
    "AdaptedPolicy": "face.adaptation",
    "CallablePolicy": "face.acting",
    "FeedbackModel": "face.feedback",
    "Labels": "face.feedback",
    "Run": "face.training",
    "UserError": "errors",
    "World": "face.worlds",
    "adapt": "face.adaptation",
    "ask": "face.feedback",
    "export_policy": "face.exporting",
    "fit_feedback": "face.feedback",
    "load_exported": "face.exporting",
    "load_policy": "face.acting",
    "make": "face.worlds",
    "refine": "face.feedback",
    "teacher_of": "face.worlds",
    "train": "face.training",
}

__all__ = [
    "AdaptedPolicy",
    "CallablePolicy",
    "FeedbackModel",
    "Labels",
    "Run",
    "UserError",
    "World",
    "adapt",
    "ask",
    "export_policy",
    "fit_feedback",
    "load_exported",
    "load_policy",
    "make",
    "refine",
    "teacher_of",
    "train",
]


def __getattr__(name: str) -> Any:
    """A name of the face, loaded when it is first asked for."""
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """The face."""
    return sorted([*__all__, "__version__"])
