"""A session that a thread prepares while the page's server starts."""

import pytest

pytest.importorskip("nicegui")

from cuelearner_jax.labelling.opening import Opening


class Prepared:
    """A session that is only closed."""

    closed = False

    def close(self):
        """Close."""
        self.closed = True


def opening(steps, session):
    """An opening whose thread tells two lines, and the steps that it has taken so far."""

    def make(tell):
        for words in ("checking", "compiling"):
            steps.append(words)
            tell(words)
        return session

    return Opening(make, lambda: steps.append("failed"), lambda words: steps.append(f"told {words}"))


def test_preparing_waits_after_its_check_of_files_until_the_server_has_started():
    steps, session = [], Prepared()
    with opening(steps, session) as opened:
        opened.wait_for_files()
        opened._thread.join(0.05)
        assert steps == ["checking"]
        assert opened.session is None
        opened.proceed()
        opened._thread.join(10)
        assert opened.session is session
    assert steps == ["checking", "told checking", "compiling", "told compiling"]
    assert session.closed


def test_it_ends_where_no_server_has_started():
    session = Prepared()
    with pytest.raises(RuntimeError, match="no server"), opening([], session):
        raise RuntimeError("no server")
    assert session.closed
