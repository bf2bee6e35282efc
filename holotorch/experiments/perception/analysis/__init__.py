"""From the answers of a study to equal-efficiency scales."""
