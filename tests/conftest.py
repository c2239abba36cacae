"""Settings of all tests: the CPU, a cache of compiled programs, checked shapes in signatures."""

import gc
import os
import signal
import sys
from collections import Counter
from functools import cache
from pathlib import Path

import jaxlib.version
import pytest
from checked import LOOSE_RANKS, install

TESTS = Path(__file__).resolve().parent

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(TESTS.parent / ".jax_cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
# Compiling is most of what the tests take: half of it with none of LLVM's optimisations, XLA's former emitters and
# each program in one piece (two workers fill two cores as it is), and what they assert holds with any.
flags = ["--xla_backend_optimization_level=0"]
if jaxlib.version.__version_info__ < (0, 11):  # JAX does not start with a flag that it no longer knows
    flags += ["--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1"]
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")  # no test reads where an operation came from
os.environ["XLA_FLAGS"] = " ".join([*flags, os.environ.get("XLA_FLAGS", "")]).strip()

# What starts the tests may ignore signals, as a shell does for work in the background, and processes pass that on.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)
signal.signal(signal.SIGTERM, signal.SIG_DFL)

install()  # before anything of these packages is imported


@cache
def lies_in(path, places):
    """Whether a file is one of these files, or lies in one of these folders of tests."""
    return any(TESTS / place in (path, *path.parents) for place in places)


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Freeze imported objects, so that the garbage collector never traverses them during collection and tests.

    Nor does it look at the programs that tests trace as often as by default, which took a twelfth of the time.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(20_000, 20, 20)
        gc.enable()


@pytest.fixture(scope="module")
def garbage_of_its_own():
    """For a file whose tests collect garbage often: what other files left is frozen and not traversed each time."""
    gc.collect()
    gc.freeze()


def pytest_addoption(parser):
    """Add the option of `make durations`."""
    parser.addoption("--durations-to", type=Path, help="write the seconds of each file of tests there")


def pytest_terminal_summary(terminalreporter, exitstatus, config):
    """Write the seconds of each file of tests, with set-up, the longest first."""
    path = config.getoption("--durations-to")
    if path is None:
        return
    seconds, tests = Counter(), Counter()
    for report in (report for reports in terminalreporter.stats.values() for report in reports):
        if hasattr(report, "duration"):
            file = report.nodeid.partition("::")[0]
            seconds[file] += report.duration
            tests[file] += report.when == "call"
    versions = f"jax {jaxlib.version.__version__}, Python {sys.version.split()[0]}, {os.cpu_count()} cores"
    total = f"{sum(tests.values()):,} tests, {sum(seconds.values()):,.0f} s over all workers"
    head = f"# {total}; {versions}; make durations"
    lines = [f"{spent:8.1f} {tests[file]:5} {file}" for file, spent in seconds.most_common()]
    path.write_text("\n".join([head, "# seconds tests file", *lines, ""]), encoding="utf-8")


@cache
def optimise_readings():
    """Compile what a reading repeats hundreds of times with optimisation, which costs less than it saves."""
    import jax

    from cuelearner_jax.reading import fitting

    fitting._update = jax.jit(fitting._update.__wrapped__, compiler_options={"xla_backend_optimization_level": 1})


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Make implicit rank promotion an error, except in the tests of `LOOSE_RANKS`.

    For all threads and before any fixture: what is traced with another setting is traced and compiled once more.
    """
    import jax  # reads the settings above

    jax.config.update("jax_numpy_rank_promotion", "allow" if lies_in(item.path, LOOSE_RANKS) else "raise")
    if "cuelearner_jax.reading.fitting" in sys.modules:
        optimise_readings()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item, nextitem):
    """Forgets compiled programs between files before the process runs out of memory maps, which ends in a crash."""
    try:
        return (yield)
    finally:
        if nextitem is None or nextitem.path != item.path:
            from cuelearner_jax.devices import release_programs

            release_programs()


def recorded():
    """Seconds of each file of tests, as `make durations` has last written them."""
    rows = (line.split() for line in (TESTS / "durations.txt").read_text().splitlines() if not line.startswith("#"))
    return {file: float(seconds) for seconds, _, file in rows}


SECONDS = recorded()
SLOW = sum(SECONDS.values()) / 150  # seconds above which `make test-quick` leaves a file out

# Files that train or call the same compiled programs: one process runs them one after the other, and compiles once.
SWEEPS = ("commands", "export", "failures", "interruption", "shards")
SHARING = {
    **{f"tests/test_{name}.py": "loop" for name in ("loop", "asking", "policies", "evaluate")},
    **{f"tests/cli/test_{name}.py": "small sweeps" for name in SWEEPS},
}
GROUPS = Counter()
for file, seconds in SECONDS.items():
    GROUPS[SHARING.get(file, file)] += seconds


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Distribute the tests by file, those of `SHARING` by the program that they share."""
    from xdist.scheduler import LoadFileScheduling

    class ByProgram(LoadFileScheduling):
        def _split_scope(self, nodeid):
            file = super()._split_scope(nodeid)
            return SHARING.get(file, file)

    return ByProgram(config, log) if config.getoption("dist") == "loadfile" else None


def pytest_collection_modifyitems(items):
    """Mark slow files and run the longest first, so that workers finish at about the same time."""
    files = {item: item.nodeid.partition("::")[0] for item in items}
    for item, file in files.items():
        if SECONDS.get(file, 0.0) > SLOW:
            item.add_marker(pytest.mark.slow)
    items.sort(key=lambda item: -GROUPS[SHARING.get(files[item], files[item])])  # keeps the order among equals
