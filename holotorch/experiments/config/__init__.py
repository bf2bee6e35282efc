"""YAML configurations: their positions in the file, their fields, and error messages."""
