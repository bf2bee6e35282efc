"""YAML configurations: positions, fields, and mistakes in words."""
