"""Export a policy's decision as files for a robot, with a contract that specifies inputs and outputs.

`runner` needs only NumPy and is copied beside every exported decision; the other modules write what it reads.
"""
