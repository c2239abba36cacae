"""A gripper over a table in MJX: reach a place, push a cube past a post, pick a cube and place it."""
