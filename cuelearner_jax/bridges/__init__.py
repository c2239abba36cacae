"""Bridges to environments and agents of other packages."""
