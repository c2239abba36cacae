"""Settings of every test: the CPU, compiled programs kept between runs, shapes in signatures checked."""

import os
from pathlib import Path

import jaxlib.version
import pytest
from checked import LOOSE_RANKS, PACKAGES
from jaxtyping import install_import_hook

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).resolve().parents[1] / ".jax_cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
# Compiling is most of what the tests take: a third of it with LLVM's first level and XLA's former emitters, and what
# they assert holds with any.
flags = ["--xla_backend_optimization_level=1"]
if jaxlib.version.__version_info__ < (0, 11):  # JAX does not start with a flag that it no longer knows
    flags.append("--xla_cpu_use_fusion_emitters=false")
os.environ["XLA_FLAGS"] = " ".join([*flags, os.environ.get("XLA_FLAGS", "")]).strip()

install_import_hook(PACKAGES, "checked.checked")  # before anything of them is imported


@pytest.fixture(scope="module", autouse=True)
def strict_ranks(request):
    """Raises at implicit rank promotion, but in the tests of `LOOSE_RANKS`."""
    import jax  # reads the settings above

    folder = request.path.parent.relative_to(Path(__file__).resolve().parent).as_posix()
    with jax.numpy_rank_promotion("allow" if folder in LOOSE_RANKS else "raise"):
        yield
