"""The tool and its pose."""
