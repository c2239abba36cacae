"""Correct the actions of a LeRobot policy, by steps in its checkpoint's processors.

    python -m lerobot_processor_cuelearner situations --policy CHECKPOINT --dataset FOLDER --out FOLDER

writes recorded situations with the actions that the policy proposes. `cuelearner export --format lerobot` adds the
steps of `steps` to a copy of a checkpoint. Neither needs JAX.
"""
