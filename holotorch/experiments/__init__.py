"""Runs described by YAML files: validation, run folders, reports."""
