"""`python -m lerobot_processor_cuelearner situations`."""

from __future__ import annotations

import argparse
from pathlib import Path

from lerobot_processor_cuelearner.situations import write


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser("lerobot_processor_cuelearner", description=__doc__)
    commands = parser.add_subparsers(required=True)
    situations = commands.add_parser("situations", help="write recorded situations with a policy's proposed actions")
    situations.add_argument("--policy", required=True, help="checkpoint of a LeRobot policy (…/pretrained_model)")
    situations.add_argument("--dataset", type=Path, required=True, help="folder of a LeRobot dataset, format v3.0")
    situations.add_argument("--out", type=Path, required=True, help="folder for the situations, new or empty")
    situations.add_argument("--count", type=int, default=200, help="number of situations (default: 200)")
    situations.add_argument("--seed", type=int, default=0, help="seed of the chosen frames")
    options = parser.parse_args()
    count = write(options.policy, options.dataset, options.out, options.count, options.seed)
    print(f'wrote {count} situations; next: cuelearner label {options.out} --cues "left,right;up,down"')


if __name__ == "__main__":
    main()
