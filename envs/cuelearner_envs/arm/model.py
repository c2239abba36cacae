"""The gripper, the cube, the post and the table as one model, for MuJoCo and for MJX.

The gripper is no arm of seven joints: three slides carry two fingers, as the end effector of Gymnasium-Robotics' Fetch
moves when it is pulled to its target. Contacts are real, and few: the cube on the table, each finger (two upright
capsules) and the post against the cube. Numbers that Fetch's public model gives (table, cube, control period, opening
of the fingers) are the same here; how far a step goes was fitted to steps of Fetch.

Frame: the world of Fetch: x forward, y to the robot's left, z up, origin on the floor.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's compiled module has no stubs)

from __future__ import annotations

import mujoco

CONTROL_PERIOD = 0.04  # [s]: 25 steps a second
SUBSTEPS = 4  # of the physics, in a step of control
TABLE = 0.4  # height of its top [m]
CUBE = 0.025  # half of an edge [m]
RESTING = TABLE + CUBE  # height of the middle of a cube on the table [m]
OPEN = 0.05  # the farthest that a finger is open, from the middle [m]
LOWEST = 0.4169  # of the gripper: fingers end just above the table [m]
FRICTION = 1.0  # of the cube on table, fingers and post, unless changed
POST_RADIUS, POST_HEIGHT = 0.02, 0.06  # [m]; the height is that of its top above the table
POST_PLACE = (1.3419, 0.7491)  # of its axis [m]
FINGER_RADIUS = 0.007  # of each of its two capsules [m]
FINGER_HALF_WIDTH = 0.0135  # of a finger along x [m]
TIP = 0.0185  # how far fingers reach below the gripper's place [m]
STIFFNESS, FINGER_STIFFNESS = 47.0, 60.0  # natural frequency of a drive, which is damped critically [rad/s]
GRIPPER_MASS, FINGER_MASS, FINGER_ARMATURE, CUBE_MASS = 10.0, 0.05, 1.5, 0.5  # [kg]
GRAVITY = 9.81  # [m/s^2]
ITERATIONS, LINE_SEARCHES = 2, 3  # of the solver, at most


def load(has_object: bool, timestep: float | None = None, iterations: int | None = None) -> mujoco.MjModel:
    """Return the model; without an object, the gripper alone, without fingers, cube and post.

    Unless given, the time step is `CONTROL_PERIOD` / `SUBSTEPS` [s], and the solver makes the few iterations of MJX.
    """
    model = mujoco.MjModel.from_xml_string(_xml(has_object))
    if timestep is not None:
        model.opt.timestep = timestep
    if iterations is not None:
        model.opt.iterations, model.opt.ls_iterations = iterations, 50
    return model


def _xml(has_object: bool) -> str:
    carried = GRIPPER_MASS + 2 * FINGER_MASS * has_object
    drives = "".join(_drive(axis, carried, STIFFNESS, GRAVITY * carried * (axis == "z")) for axis in "xyz")
    slides = "".join(
        f'<joint name="{axis}" type="slide" axis="{vector}"/>'
        for axis, vector in (("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1"))
    )
    solids, fingers, cube, pairs = _objects() if has_object else ("", "", "", "")
    if has_object:
        drives += "".join(_drive(side, FINGER_MASS + FINGER_ARMATURE, FINGER_STIFFNESS) for side in ("right", "left"))
    return f"""
<mujoco model="arm">
  <option timestep="{CONTROL_PERIOD / SUBSTEPS}" iterations="{ITERATIONS}" ls_iterations="{LINE_SEARCHES}"
    gravity="0 0 -{GRAVITY}">
    <flag eulerdamp="disable"/>
  </option>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    {solids}
    <body name="gripper">
      <inertial pos="0 0 0" mass="{GRIPPER_MASS}" diaginertia="0.1 0.1 0.1"/>
      {slides}{fingers}
    </body>
    {cube}
  </worldbody>
  <contact>{pairs}</contact>
  <actuator>{drives}</actuator>
</mujoco>"""


def _objects() -> tuple[str, str, str, str]:
    """Table, gripper, cube and post, with their contacts."""
    x, y = POST_PLACE
    top = TABLE + POST_HEIGHT - POST_RADIUS
    solids = f'''<geom name="table" type="plane" pos="0 0 {TABLE}" size="0 0 0.01"/>
    <geom name="post" type="capsule" fromto="{x} {y} {TABLE - 0.02} {x} {y} {top}" size="{POST_RADIUS}"/>'''
    cube = f'''<body name="cube"><freejoint name="cube"/>
      <geom name="cube" type="box" size="{CUBE} {CUBE} {CUBE}" mass="{CUBE_MASS}"/></body>'''
    touching = ["table", *(f"{side}{number}" for side in ("right", "left") for number in (0, 1)), "post"]
    friction = f"{FRICTION} {FRICTION} 0.005 0.0001 0.0001"
    pairs = "".join(f'<pair geom1="{name}" geom2="cube" condim="3" friction="{friction}"/>' for name in touching)
    return solids, _finger("right", 1) + _finger("left", -1), cube, pairs


def _finger(side: str, way: int) -> str:
    """Return the XML of one finger, which opens along y by `way`; Fetch's right finger has the larger y."""
    apart = FINGER_HALF_WIDTH - FINGER_RADIUS
    capsules = "".join(
        f'<geom name="{side}{number}" type="capsule" mass="0" size="{FINGER_RADIUS}" '
        f'fromto="{x} {way * FINGER_RADIUS} {FINGER_RADIUS - TIP} {x} {way * FINGER_RADIUS} 0.05"/>'
        for number, x in enumerate((-apart, apart))
    )
    return (
        f'<body name="{side}"><inertial pos="0 0 0" mass="{FINGER_MASS}" diaginertia="0.001 0.001 0.001"/>'
        f'<joint name="{side}" type="slide" axis="0 {way} 0" armature="{FINGER_ARMATURE}"/>{capsules}</body>'
    )


def _drive(joint: str, mass: float, stiffness: float, lift: float = 0.0) -> str:
    """A critically damped drive to a place, `lift` against gravity [N]."""
    spring, damper = mass * stiffness**2, 2 * mass * stiffness
    return (
        f'<general name="{joint}" joint="{joint}" biastype="affine" gainprm="{spring}" '
        f'biasprm="{lift} {-spring} {-damper}"/>'
    )
