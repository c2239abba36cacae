"""Sessions on the bandit, closed after each test."""

import jax
import pytest
from sessions import plan

from cuelearner_jax.labelling.session import Session


@pytest.fixture
def opened(tmp_path):
    """Opens sessions in the test's folder, and closes them."""
    sessions = []

    def open_one(folder="labels", **asked):
        with jax.numpy_rank_promotion("allow"):
            sessions.append(Session(plan(**asked), tmp_path / folder))
        return sessions[-1]

    yield open_one
    for session in sessions:
        session.close()
