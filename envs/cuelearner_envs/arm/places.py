"""Positions in the arm's world, beside those of `model`'s solids."""

SPREAD = 0.15  # of cubes and goals round where the gripper begins, along each axis [m]
APART = 0.1  # of the cube from there, at least [m]
HIGHEST = 0.45  # of a goal in the air over the table, `pick` alone [m]
HOME = (1.3419, 0.7491, 0.5347)  # where the gripper begins [m]
LOW_HOME = (1.3627, 0.7491, 0.4169)  # where the gripper begins to push, if no post stands [m]
LANE = ((0.09, 0.15), 0.06)  # of cube and goal before and behind the post along x, and across at most [m]
BASE = (0.6918, 0.7441)  # the robot's base, about which its camera turns: x, y [m]
