"""Environments and agents of other packages."""
