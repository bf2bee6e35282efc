"""The same as the chart ``joint``, of whole volumes: slabs are sampled as often as needed, not once for each plane."""

from dataclasses import replace

from holotorch.experiments.joint.charts.chart import FULL, QUICK, Chart, drawn


def whole(quick: bool = False) -> Chart:
    """Table rows of all cases, further tables by name, PNG figures by name, and lines of text."""
    return drawn(replace(QUICK if quick else FULL, samples=None))
