"""Run folders: claims, signals, checkpoints, tables, pictures and pages."""
