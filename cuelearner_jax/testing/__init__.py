"""Conformance checks for parts of your own. Each raises AssertionError with one line that says what to fix.

An exception of a part keeps its own traceback. A check compiles once or twice and takes seconds; call it from a test,
with a world as small as there is.
"""

from cuelearner_jax.testing.environments import check_environment
from cuelearner_jax.testing.guidances import check_guidance
from cuelearner_jax.testing.laws import check_policy, check_space
from cuelearner_jax.testing.tasks import check_task

__all__ = ["check_environment", "check_guidance", "check_policy", "check_space", "check_task"]
