"""Map-less navigation of a quadruped with a lidar: worlds, sensor, motion, environment and a teacher with a map."""

from cuelearner_envs.navigation.lidar import BEAM_ANGLES, scan
from cuelearner_envs.navigation.world import NavigationWorld
from cuelearner_envs.navigation.worlds import generate

__all__ = ["BEAM_ANGLES", "NavigationWorld", "generate", "scan"]
