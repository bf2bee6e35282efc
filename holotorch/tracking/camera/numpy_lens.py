"""Distortion of a camera in NumPy, for a tracker's many small calls, which take a third of their time in PyTorch."""

import numpy as np
from numpy.typing import NDArray

from holotorch.tracking.camera.camera import Camera

Points = NDArray[np.complex128]  # x + i y

_STEPS = 5  # Newton steps of the inverse distortion
_MISSED_PX = 1e-9  # pixels: largest error of an undistorted point, as in camera.py


class Lens:
    """The projection of :class:`Camera` for arrays of complex numbers x + i y; tests compare the two.

    Attributes:
        scale: Pixels per unit of the plane z = 1, at the principal point.
        light: float32 [256] light of each 8-bit level.
    """

    def __init__(self, camera: Camera):
        self.camera = camera
        (self._fx, _, self._cx), (_, self._fy, self._cy), _ = camera.matrix.tolist()
        self._k1, self._k2, self._p1, self._p2, self._k3 = camera.distortion.tolist()
        self.scale = (self._fx + self._fy) / 2
        self._uneven = (self._fx - self._fy) / 2
        self.light = camera.table().detach().cpu().numpy()

    def distort(self, plane: Points) -> Points:
        """Pixels of points on the plane z = 1."""
        # Computes fx x + i fy y of a complex number, and skips terms that are zero for this lens, as the methods below.
        pixels = self._apply_distortion(plane)
        uneven = pixels.conj() * self._uneven if self._uneven else 0.0
        pixels *= self.scale
        return pixels + (uneven + complex(self._cx, self._cy))

    def undistort(self, pixels: Points) -> Points:
        """Points [n] on the plane z = 1 of pixels [n]; NaN where there is none."""
        distorted = (pixels.real - self._cx) / self._fx + 1j * (pixels.imag - self._cy) / self._fy
        plane = distorted
        for _ in range(_STEPS):
            square = plane.real**2 + plane.imag**2
            # Newton steps with the derivative of the radial distortion; the tangential one is 1000 times smaller.
            rise = self._k1 + square * (2 * self._k2 + 3 * square * self._k3)
            even, odd = self._radial(square) + square * rise, plane * plane * rise
            missed = self._apply_distortion(plane) - distorted
            whole = even * even - odd.real**2 - odd.imag**2
            plane = plane - (even * missed - odd * missed.conj()) / np.where(np.abs(whole) > 1e-9, whole, np.inf)
        missed = np.abs(self.distort(plane) - pixels)
        if bool(((missed <= _MISSED_PX) & (np.abs(plane) <= self.camera.valid_radius)).all()):
            return plane
        # Outside the valid radius, or near its border, where the slower method of the camera is more robust.
        given = self.camera.matrix.new_tensor(np.stack([pixels.real, pixels.imag], -1).tolist())
        points = self.camera.undistort(given).detach().cpu().numpy()
        return points[:, 0] + 1j * points[:, 1]

    def _radial(self, square: np.ndarray) -> np.ndarray:
        most = self._k2 + square * self._k3 if self._k3 else self._k2
        return 1 + square * (self._k1 + square * most)

    def _apply_distortion(self, plane: Points) -> Points:
        x, y = plane.real, plane.imag
        square = x * x + y * y
        radial = self._radial(square)
        if self._p1 or self._p2:
            radial += (plane * complex(2 * self._p2, -2 * self._p1)).real
            return plane * radial + complex(self._p2, self._p1) * square
        return plane * radial
