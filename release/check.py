"""Build the sdist and the wheel, and try the wheel in an empty environment of each Python.

    python release/check.py --pythons 3.11 3.12 3.13

The wheel is built from the sdist, so that both are whole. Every environment holds the wheel with the extra `label` and
the pinned versions of constraints.txt, and nothing else; commands run in an empty folder. A Python is a version, which
uv finds or downloads, or the path of an interpreter. The script stops at the first command that fails.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
UV = [sys.executable, "-m", "uv"]
LARGEST_WHEEL = 10_000_000  # bytes
TINY = ["--seeds", "1", "--labels", "20", "--guidance", "none", "relative", "--sizes.fit-steps", "20"]
SHORT = ["--schedule.total-steps", "400", "--schedule.guidance-until", "200", "--schedule.checkpoint-every", "200"]
COMMANDS = (  # in turn, in one folder
    ["evaluate", "shipped:billiards", "--steps", "10", "--envs", "10"],
    ["evaluate", "shipped:arm", "--episodes", "2"],
    ["evaluate", "shipped:navigation", "--episodes", "2"],
    ["evaluate", "billiards", "--task.table", "easy", "--policy", "teacher", "--steps", "4", "--envs", "4"],
    ["sweep", "billiards", "--preset", "quickstart", *TINY, *SHORT, "--out", "runs/tiny"],
    ["report", "runs/tiny", "--out", "report"],
    ["export", "shipped:navigation", "--format", "numpy", "--out", "exported"],
)
IN_PYTHON = """
import sys, numpy as np, cuelearner_jax as cl, cuelearner_envs
policy = cl.load_policy("shipped:navigation")
size = sum(quantity.size for quantity in policy.observation)
assert abs(np.linalg.norm(policy(np.full(size, 0.5))) - 1) < 1e-6
assert cl.__file__.startswith(sys.prefix) and cuelearner_envs.__file__.startswith(sys.prefix), "a checkout is used"
"""


def main() -> int:
    """Build, then check every Python; return 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pythons", nargs="+", default=["3.11", "3.12", "3.13"], help="versions, or interpreters")
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder of the sdist and the wheel")
    asked = parser.parse_args()
    wheel = build(asked.out)
    for python in asked.pythons:
        with tempfile.TemporaryDirectory() as folder:
            check(wheel, python, Path(folder))
    print(f"\n{wheel.name} works with Python {', '.join(asked.pythons)}")
    return 0


def build(out: Path) -> Path:
    """Return the wheel, which is built from the sdist beside it. Raises SystemExit for a wheel that is too large."""
    out.mkdir(parents=True, exist_ok=True)
    for old in (*out.glob("cuelearner_jax-*.whl"), *out.glob("cuelearner_jax-*.tar.gz")):
        old.unlink()
    call([*UV, "build", "--out-dir", str(out), str(ROOT)], ROOT, dict(os.environ))
    (wheel,), (sdist,) = out.glob("cuelearner_jax-*.whl"), out.glob("cuelearner_jax-*.tar.gz")
    for file in (sdist, wheel):
        print(f"{file.name}: {file.stat().st_size / 1e6:.1f} MB")
    if wheel.stat().st_size > LARGEST_WHEEL:
        raise SystemExit(f"{wheel.name} is larger than {LARGEST_WHEEL / 1e6:.0f} MB: ship less")
    return wheel


def check(wheel: Path, python: str, folder: Path) -> None:
    """Install the wheel in an empty environment below `folder` and run what a user would run first."""
    venv, work = folder / "venv", folder / "work"
    work.mkdir()
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    environment |= {"JAX_PLATFORMS": "cpu", "PATH": f"{venv / 'bin'}:{environment['PATH']}"}
    call([*UV, "venv", "--no-project", "--quiet", "--python", python, str(venv)], work, environment)
    install = [*UV, "pip", "install", "--quiet", "--python", str(venv / "bin" / "python")]
    call([*install, "--constraints", str(ROOT / "constraints.txt"), f"{wheel}[label]"], work, environment)
    versions = "import sys, jax; print('Python', sys.version.split()[0], 'with JAX', jax.__version__)"
    call(["python", "-c", versions], work, environment)
    version = re.match(r"cuelearner_jax-([^-]+)-", wheel.name)
    told = output(["cuelearner", "--version"], work, environment)
    if version is None or told.stdout != f"cuelearner {version[1]}\n":
        raise SystemExit(f"cuelearner --version says {told.stdout!r}{told.stderr}, the wheel is {wheel.name}")
    call(["python", "-c", IN_PYTHON], work, environment)
    for command in COMMANDS:
        call(["cuelearner", *command], work, environment)
    open_page(work, environment)


def call(command: list[str], folder: Path, environment: dict[str, str]) -> None:
    """Run a command and print how long it took. Raises SystemExit, with its output, if it fails."""
    began = time.perf_counter()
    done = output(command, folder, environment)
    shown = " ".join(word if "\n" not in word else "..." for word in command)
    if done.returncode:
        raise SystemExit(f"{shown}\nended with status {done.returncode}:\n{done.stdout}{done.stderr}")
    print(f"{time.perf_counter() - began:6.1f} s  {shown}", flush=True)
    if done.stdout and command[:2] == ["python", "-c"]:
        print(done.stdout, end="")


def output(command: list[str], folder: Path, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """Run a command; return its output and exit status."""
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def open_page(folder: Path, environment: dict[str, str]) -> None:
    """Start the labelling page, open its first question, stop by Ctrl-C. Raises SystemExit if one of these fails."""
    command = ["cuelearner", "label", "navigation", "--out", "labels/mine"]
    began = time.perf_counter()
    with subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        limit = threading.Timer(600, process.kill)
        limit.start()
        told, address = "", None
        for line in process.stdout:
            told += line
            if found := re.search(r"http://127\.0\.0\.1:\d+\S*", line):
                address = found[0]
                break
        if address is None:
            raise SystemExit(f"{' '.join(command)} opened no page:\n{told}")
        page = ""
        while "Which way" not in page and process.poll() is None:  # until then the page says what is being prepared
            time.sleep(1)
            with urllib.request.urlopen(address, timeout=60) as answer:
                page = answer.read().decode()
        process.send_signal(signal.SIGINT)
        told += process.stdout.read()
        status = process.wait()
        limit.cancel()
    if status != 130 or "Which way" not in page:
        raise SystemExit(f"{' '.join(command)} ended with status {status}:\n{told}")
    print(f"{time.perf_counter() - began:6.1f} s  {' '.join(command)}, the page opened, Ctrl-C")


if __name__ == "__main__":
    raise SystemExit(main())
