"""An exported navigation policy at work in C MuJoCo, without JAX: a robot with a lidar crosses a hall of obstacles.

    cuelearner export docs/data/navigation_agent --format numpy --out runs/walker
    python examples/exported_in_mujoco.py runs/walker

Prints how the walk ends.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's compiled module has no stubs)

import sys

import mujoco
import numpy as np

from cuelearner_jax.export.runner import Decision  # on a robot: the decide.py that lies beside the decision

START, GOAL, PERIOD, LAG, TURN = np.array([-5.0, 0.0]), np.array([5.0, 0.0]), 0.2, 0.1, 1.5  # [m], [s], [rad/s]
BEAMS = np.deg2rad(np.arange(-135.0, 136.0))
BOXES = [(-3, 0.5, 0.4), (-1, -1, 0.5), (0, 1.5, 0.6), (1.5, -0.3, 0.4), (3, 1, 0.5)]  # x, y, half the side [m]
WALLS = [(0, 4, 7, 0.1), (0, -4, 7, 0.1), (7, 0, 0.1, 4), (-7, 0, 0.1, 4)]
SOLIDS = [(x, y, side, side) for x, y, side in BOXES] + WALLS
MODEL = f"""<mujoco><option gravity="0 0 0" timestep="0.01"/><worldbody>
{"".join(f'<geom type="box" pos="{x} {y} 0.5" size="{a} {b} 0.5"/>' for x, y, a, b in SOLIDS)}
<body pos="{START[0]} {START[1]} 0.5"><geom type="capsule" fromto="-0.2 0 0 0.2 0 0" size="0.265" mass="50"/>
<joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/><joint name="yaw" axis="0 0 1"/>
</body></worldbody><actuator><velocity joint="x" kv="{50 / LAG}"/><velocity joint="y" kv="{50 / LAG}"/>
<velocity joint="yaw" kv="100"/></actuator></mujoco>"""


def drive(folder, longest=200):
    """Return a walk's end ("goal", "collision" or "timeout") and its places [m], one each 0.2 s."""
    decide, model = Decision(folder), mujoco.MjModel.from_xml_string(MODEL)
    data, previous, places = mujoco.MjData(model), np.zeros((3, 2)), [START]
    for _ in range(longest):
        mujoco.mj_forward(model, data)
        place, yaw = START + data.qpos[:2], data.qpos[2]
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])  # from body to world
        rays = np.stack([np.cos(yaw + BEAMS), np.sin(yaw + BEAMS), 0 * BEAMS], -1)
        hit, eye = np.zeros(1, np.int32), np.array([*place, 0.5])
        ranges = np.array([mujoco.mj_ray(model, data, eye, ray, None, 1, 1, hit) for ray in rays])
        offset = (GOAL - place) @ turn
        distance = np.linalg.norm(offset)
        near = np.exp(-np.where(ranges < 0, 10.0, np.minimum(ranges, 10.0)))
        action = decide(np.concatenate([near, offset / distance, [distance / 15], previous.ravel()]))
        previous = np.stack([action, *previous[:2]])
        turned = np.clip(np.arctan2(action[1], action[0]), -TURN * PERIOD, TURN * PERIOD)
        data.ctrl[:] = *(turn @ action), turned / PERIOD  # walks at 1 m/s, and turns toward where it walks
        for _ in range(round(PERIOD / model.opt.timestep)):
            mujoco.mj_step(model, data)
        places.append(START + data.qpos[:2])
        if data.ncon or np.linalg.norm(GOAL - places[-1]) < 0.5:
            return "collision" if data.ncon else "goal", np.array(places)
    return "timeout", np.array(places)


if __name__ == "__main__":
    ended, places = drive(sys.argv[1])
    assert "jax" not in sys.modules
    print(f"{ended} after {0.2 * (len(places) - 1):.1f} s")
