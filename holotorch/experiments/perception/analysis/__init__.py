"""Analysis of the answers of a study: equal-efficiency scales and their uncertainty."""
