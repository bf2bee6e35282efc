"""Oracles of perception, written from the page: Table 2.2 worked by hand, lines by normal equations, rays."""

import math

import numpy as np

# (size, eccentricity of the target): S at 40, 50, 60 and 70 deg, by hand from the printed alpha and beta.
SIZES = {
    (5, 10): (7.76, 12.46, 17.16, 21.86),
    (5, 20): (5.70, 11.20, 16.70, 22.20),
    (5, 30): (6.52, 11.92, 17.32, 22.72),
    (5, 40): (3.96, 9.36, 14.76, 20.16),
    (10, 10): (7.69, 12.89, 18.09, 23.29),
    (10, 20): (8.40, 14.20, 20.00, 25.80),
    (10, 30): (9.48, 15.98, 22.48, 28.98),
    (15, 10): (7.51, 14.01, 20.51, 27.01),
    (15, 20): (13.73, 18.83, 23.93, 29.03),
    (15, 30): (8.06, 14.76, 21.46, 28.16),
}
# As printed.
ANOVA = {
    (5, 10): (7.02, 0.0002),
    (5, 20): (11.96, 4.46e-7),
    (5, 30): (7.96, 5.75e-5),
    (5, 40): (12.48, 2.45e-7),
    (10, 10): (4.78, 0.0033),
    (10, 20): (9.3, 1.13e-5),
    (10, 30): (7.04, 0.0002),
    (15, 10): (4.22, 0.0067),
    (15, 20): (5.32, 0.0017),
    (15, 30): (5.31, 0.0017),
}


def line(x, y):
    """Slope, intercept and their covariance [2, 2] by the normal equations."""
    design = np.stack([np.asarray(x, float), np.ones(len(x))], 1)
    inverse = np.linalg.inv(design.T @ design)
    found = inverse @ design.T @ np.asarray(y, float)
    rest = np.asarray(y, float) - design @ found
    return found, inverse * (rest @ rest) / (len(x) - 2)


def direction(elevation_deg, azimuth_deg):
    """Unit vector: x right, y up, z ahead."""
    e, a = math.radians(elevation_deg), math.radians(azimuth_deg)
    return np.array([math.cos(e) * math.sin(a), math.sin(e), math.cos(e) * math.cos(a)])


def between(first, second):
    """Angle in degrees between two vectors, from the triangle of unit vectors."""
    u, v = (np.asarray(each, float) / np.linalg.norm(each) for each in (first, second))
    return math.degrees(2 * math.asin(min(1.0, np.linalg.norm(u - v) / 2)))


def screen_point(y_m, x_m, distance, radius=None):
    """Point of a flat (radius None) or cylindrical screen, y up, for metres along its surface, y down."""
    if radius is None:
        return np.array([x_m, -y_m, distance])
    turn = x_m / radius
    return np.array([radius * math.sin(turn), -y_m, distance - radius + radius * math.cos(turn)])
