"""What the page shows of a run of each kind."""
