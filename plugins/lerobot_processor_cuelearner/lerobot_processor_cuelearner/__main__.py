"""`python -m lerobot_processor_cuelearner situations`, `camera` and `judge`."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from lerobot_processor_cuelearner import camera
from lerobot_processor_cuelearner.judging import judge
from lerobot_processor_cuelearner.kinematics import UNITS, hand_of
from lerobot_processor_cuelearner.situations import write


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser("lerobot_processor_cuelearner", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    judging = commands.add_parser("judge", help="tell which of two evaluations of the same episodes is better")
    judging.add_argument("before", type=Path, help="output folder of lerobot-eval, of the policy as it was")
    judging.add_argument("after", type=Path, help="the same of the corrected policy, with the same seed")
    cameras = commands.add_parser("camera", help="find how cameras moved, and let the policy see pictures as before")
    cameras.add_argument(
        "--policy", type=Path, required=True, help="checkpoint of a LeRobot policy (…/pretrained_model)"
    )
    cameras.add_argument(
        "--before", type=Path, required=True, help="folder of the LeRobot dataset that it learned from"
    )
    cameras.add_argument("--after", type=Path, required=True, help="one from after the move; a few episodes will do")
    cameras.add_argument("--out", type=Path, required=True, help="folder for the new checkpoint")
    situations = commands.add_parser("situations", help="write recorded situations with a policy's proposed actions")
    situations.add_argument("--policy", required=True, help="checkpoint of a LeRobot policy (…/pretrained_model)")
    situations.add_argument("--dataset", type=Path, required=True, help="folder of a LeRobot dataset, format v3.0")
    situations.add_argument("--out", type=Path, required=True, help="folder for the situations, new or empty")
    situations.add_argument("--count", type=int, default=200, help="number of situations (default: 200)")
    situations.add_argument(
        "--first", type=int, default=0, help="take only the first frames of episodes (default: all)"
    )
    situations.add_argument("--seed", type=int, default=0, help="seed of the chosen frames")
    situations.add_argument("--mjcf", type=Path, help="the robot's MJCF: actions are then the positions of its hand")
    situations.add_argument("--site", help="site of the MJCF at the hand")
    situations.add_argument(
        "--joints", type=lambda text: text.split(","), default=[], help="joint of each entry of the action, as a,b,,d"
    )
    situations.add_argument("--joint-unit", choices=list(UNITS), default="radians", help="of the action's entries")
    situations.add_argument(
        "--projection", action="append", default=[], metavar="CAMERA=FILE", help="3x4 matrix from metres to pixels"
    )
    situations.add_argument(
        "--no-effects", action="store_true", help="do not ask the policy how its actions change with the state"
    )
    options = parser.parse_args()
    if options.command == "judge":
        print(judge(options.before, options.after))
        return
    if options.command == "camera":
        print("\n".join(camera.write(options.policy, options.before, options.after, options.out)))
        return
    if options.first < 0 or options.count < 1:
        parser.error("give --first 0 or more and --count 1 or more")
    if (options.mjcf is None) != (options.site is None):
        parser.error("give --mjcf and --site together")
    if wrong := [text for text in options.projection if "=" not in text]:
        parser.error(f"--projection {wrong[0]} names no file: give CAMERA=matrix.json")
    matrices = {name: Path(file) for name, _, file in (text.partition("=") for text in options.projection)}
    hand = partial(hand_of, options.mjcf, options.site, options.joints, options.joint_unit) if options.mjcf else None
    count = write(
        options.policy,
        options.dataset,
        options.out,
        options.count,
        options.seed,
        hand,
        matrices,
        not options.no_effects,
        options.first,
    )
    cues = "forward,back;left,right;up,down" if hand else "ENTRY=less,more"
    print(f'wrote {count} situations; next: cuelearner label {options.out} --cues "{cues}"')


if __name__ == "__main__":
    main()
