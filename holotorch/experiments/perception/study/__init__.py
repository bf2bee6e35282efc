"""The study of perception time, in a browser."""
