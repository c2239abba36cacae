"""Agreement of `cuelearner_envs.navigation.scan` with MuJoCo's rays (`mj_ray`) in the same validation worlds.

    python benchmarks/lidar_parity.py --write

MuJoCo casts its rays in double precision through a model of the world in three dimensions, half a metre above the
floor; ours are in single precision. The sensor is anywhere in the hall: of four poses two are drawn uniformly, one lies
inside a solid (both then read the way out) and one within 0.3 m of a solid. Beams are equal if they differ by at most
1 mm; a beam that meets nothing within the range reads the range. A beam that differs by more is "at an edge" if one of
MuJoCo's own readings, with the beam turned by up to 1e-5 rad, is equal to ours: it grazes a solid, and rounding decides
whether it meets it.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco_world
import numpy as np

from cuelearner_envs.navigation.config import NavigationConfig, Style, make_environment
from cuelearner_envs.navigation.lidar import MAX_RANGE, scan
from cuelearner_jax.storage.provenance import provenance

RESULTS = Path(__file__).parent / "results" / "lidar_parity.json"
STYLES: tuple[Style, ...] = ("clutter", "rooms", "corridor")
EQUAL = 1e-3  # [m]
TURNS = np.concatenate([-np.geomspace(1e-5, 1e-8, 7), np.geomspace(1e-8, 1e-5, 7)])  # of a doubtful beam [rad]

scan_all = jax.jit(jax.vmap(jax.vmap(scan, (None, 0))))


def compare(style: Style, worlds: int, poses: int, seed: int) -> dict[str, float]:
    """Return one row of the table: shares and differences over random poses in validation worlds."""
    many = make_environment(NavigationConfig(style=style, worlds=worlds), "validation").worlds
    rng = np.random.default_rng(seed)
    singles = [jax.tree.map(lambda leaf, number=number: np.asarray(leaf[number]), many) for number in range(worlds)]
    places = np.stack([mujoco_world.poses(rng, world, poses) for world in singles])
    ours = np.asarray(scan_all(many, jnp.asarray(places)), float)
    theirs, at_edge = np.empty_like(ours), 0
    for number, world in enumerate(singles):
        model = mujoco_world.model(world)
        data = mujoco_world.settled(model)
        for which, pose in enumerate(places[number]):
            theirs[number, which] = mujoco_world.scan(model, data, pose, MAX_RANGE)
            for beam in np.flatnonzero(np.abs(ours[number, which] - theirs[number, which]) > EQUAL):
                near = mujoco_world.scan(model, data, pose, MAX_RANGE, mujoco_world.ANGLES[beam] + TURNS)
                at_edge += bool((np.abs(near - ours[number, which, beam]) <= EQUAL).any())
    apart = np.abs(ours - theirs)
    return {
        "worlds": worlds,
        "poses": worlds * poses,
        "beams": int(ours.size),
        "equal": float((apart <= EQUAL).mean()),
        "worst_equal_mm": float(apart[apart <= EQUAL].max() * 1e3),
        "beyond": int((apart > EQUAL).sum()),
        "beyond_at_edge": at_edge,
        "worst_mm": float(apart.max() * 1e3),
        "p99_99_mm": float(np.quantile(apart, 0.9999) * 1e3),
        "within_range": float((theirs < MAX_RANGE).mean()),
    }


def main() -> None:
    """Compare every style and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--styles", nargs="+", default=list(STYLES), choices=STYLES)
    parser.add_argument("--worlds", type=int, default=200, help="validation worlds of each style")
    parser.add_argument("--poses", type=int, default=4, help="random poses in each world, 271 beams from each")
    parser.add_argument("--seed", type=int, default=0, help="of the poses")
    parser.add_argument(
        "--write", type=Path, nargs="?", const=RESULTS, help="write the figures to a JSON file (default: %(const)s)"
    )
    arguments = parser.parse_args()

    rows = []
    for style in arguments.styles:
        began = time.perf_counter()
        rows.append({"style": style, **compare(style, arguments.worlds, arguments.poses, arguments.seed)})
        print(f"{style}: {time.perf_counter() - began:.0f} s", flush=True)

    print(f"\n{'':24}{'equal':>12}{'worst equal':>13}{'beyond':>8}{'at an':>7}{'meet a solid':>14}")
    print(f"{'style':10}{'worlds':>6}{'beams':>8}{'within 1 mm':>12}{'[mm]':>13}{'1 mm':>8}{'edge':>7}{'in range':>14}")
    for row in rows:
        print(
            f"{row['style']:10}{row['worlds']:6d}{row['beams']:8d}{row['equal']:12.4%}{row['worst_equal_mm']:13.4f}"
            f"{row['beyond']:8d}{row['beyond_at_edge']:7d}{row['within_range']:14.1%}"
        )
    if arguments.write:
        arguments.write.write_text(json.dumps({**provenance(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
