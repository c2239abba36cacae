"""Runs of many lanes: grids, lane groups, sweeps, shards, clusters, and the trained policies."""
