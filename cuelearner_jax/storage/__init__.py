"""Files on disk: tables of results, labels, checkpoints, run folders and provenance."""
