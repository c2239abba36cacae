"""Runs of many lanes: grids, lane groups, sweeps, shards, and the trained policies."""
