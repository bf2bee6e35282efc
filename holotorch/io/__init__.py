"""Files: the only part that opens them. Import from its modules; the package itself loads nothing."""
