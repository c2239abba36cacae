"""One tiny run that the tests of the command line share."""

import fcntl
import sys
from pathlib import Path

import pytest
from small_runs import BANDIT, SWEEP, listing

from cuelearner_jax import terminal
from cuelearner_jax.cli import main
from cuelearner_jax.tasks import registry


@pytest.fixture(autouse=True)
def _no_progress_lines(monkeypatch):
    """Standard error holds messages alone, however slow the machine is; tests/test_terminal.py has progress lines."""
    monkeypatch.setattr(terminal, "FIRST", 600.0)


@pytest.fixture
def run_folder(small_folder) -> Path:
    """A run whose task is known to this process; nobody writes in it."""
    registry.resolve(BANDIT)
    return small_folder


@pytest.fixture(scope="session")
def small_folder(tmp_path_factory, worker_id) -> Path:
    """Made by the first worker that asks."""
    base = tmp_path_factory.getbasetemp()
    folder = (base if worker_id == "master" else base.parent) / "small"
    with open(folder.with_suffix(".lock"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "relative" / "results.parquet").exists():
            assert main([*SWEEP, "--out", str(folder)]) == 0
    return folder


@pytest.fixture
def refused(capsys):
    """Runs a command that must be refused: status 2, one line that names the remedy, nothing changed in a folder."""

    def run(command: list[str], says: str, folder: Path) -> None:
        capsys.readouterr()  # what earlier commands of the test have told
        before = listing(folder)
        assert main([str(part) for part in command]) == 2
        told = [line for line in capsys.readouterr().err.splitlines() if " lanes, " not in line]
        assert len(told) == 1, told
        assert told[0].startswith("error: ")
        assert says in told[0], told[0]
        assert listing(folder) == before

    return run


@pytest.fixture(scope="module")
def home(request, tmp_path_factory):
    """A folder with the code of a user's own that a file of tests has as OWN, in the module that it has as NAME."""
    folder = tmp_path_factory.mktemp("home")
    (folder / f"{request.module.NAME}.py").write_text(request.module.OWN)
    return folder


@pytest.fixture
def forget(request):
    """Makes the process one that has not met the user's own task."""

    def forgetting():
        registry._registered.clear()
        sys.modules.pop(request.module.NAME, None)

    return forgetting


@pytest.fixture
def there(home, forget, monkeypatch):
    """In that folder, in a process that has not met the user's own task."""
    monkeypatch.chdir(home)
    monkeypatch.setattr(sys, "path", list(sys.path))
    forget()
    yield home
    forget()
