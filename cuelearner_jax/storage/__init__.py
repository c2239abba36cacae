"""What is kept on disk: tables of results, labels, checkpoints, run folders, and where numbers come from."""
