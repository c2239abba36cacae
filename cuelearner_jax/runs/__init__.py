"""Runs of many lanes: grid, blocks of lanes, sweep, pieces, clusters, what a finished run acts with."""
