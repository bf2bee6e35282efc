"""The study of perception time, which runs in a browser."""
