"""A task, a guidance and a policy of one's own: each one file that the package knows nothing of."""
