"""Accuracy, stability and latency of a tracker."""
