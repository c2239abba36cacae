"""A small sweep that `test_devices` runs in processes of their own, on as many devices as JAX_NUM_CPU_DEVICES says.

python many_devices.py FOLDER LOOK TO STOP AT | communication
"""

import contextlib
import re
import sys
from pathlib import Path

import jax
import probes
import pytest
from small_runs import stopping_at

from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.loop import start_clock
from cuelearner_jax.runs import lanes
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.order import Order
from cuelearner_jax.studies import train
from cuelearner_jax.terminal import Interrupted

CONFIG = probes.config(
    sizes={"feedback_layers": (16,), "fit_steps": 100},
    scalars={"discount": 0.5},
    schedule={"total_steps": 64, "guidance_until": 48, "eval_every": 16, "checkpoint_every": 32},
    agent={"q_layers": (16,), "replay_capacity": 40},
)
GRID = Grid(("relative",), seeds=(3, 5, 8), labels=(15, 30))  # 6 lanes, which do not divide among 4


def run(out: Path, stop_at: int | None = None, **options) -> None:
    """The sweep, interrupted at the given look at the event."""
    with stopping_at(stop_at), contextlib.nullcontext() if stop_at is None else pytest.raises(Interrupted):
        train.run(Order(probes.make_task(), CONFIG, GRID, out, **options))


def communication() -> list[str]:
    """Operations between devices in the compiled training."""
    env = probes.Window()
    group = lanes.LaneGroup(CONFIG, env, guidances.make("relative", CONFIG.sizes, env), GRID)
    (block,) = group.start()
    text = group.program.train.lower(env, CONFIG.settings, start_clock(), block, 4).compile().as_text()
    assert "while" in text
    assert len(block.key.sharding.device_set) == jax.device_count()
    return re.findall(r"all-reduce|all-gather|all-to-all|collective-permute|reduce-scatter", text)


if __name__ == "__main__":
    asked, *rest = sys.argv[1:]
    if asked == "communication":
        print(jax.device_count(), communication())
    else:
        run(Path(asked), int(rest[0]))
