"""Projection of a camera in NumPy, which takes a third of PyTorch's time for the many small calls of a tracker."""

import numpy as np
from numpy.typing import NDArray

from holotorch.tracking.camera.camera import MAX_ERROR_PX, Camera

Points = NDArray[np.complex128]  # points x + i y of the image in pixels, or of the plane z = 1


class Lens:
    """The methods ``distort`` and ``undistort`` of :class:`Camera` for arrays of complex numbers x + i y.

    Attributes:
        camera: The camera.
        scale: Mean of both focal lengths in pixels.
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
        """Pixels of points on the plane z = 1, of any shape."""
        # fx x + i fy y is scale times the number x + i y, plus (fx - fy) / 2 times its conjugate, which is often zero.
        pixels = self._apply_distortion(plane)
        uneven = pixels.conj() * self._uneven if self._uneven else 0.0
        pixels *= self.scale
        return pixels + (uneven + complex(self._cx, self._cy))

    def undistort(self, pixels: Points) -> Points:
        """Points [n] on the plane z = 1 of pixels [n]; NaN where the distortion has no inverse."""
        distorted = (pixels.real - self._cx) / self._fx + 1j * (pixels.imag - self._cy) / self._fy
        plane = distorted
        for _ in range(5):
            # A Newton step with the derivative of the radial distortion, as the tangential one is 1000 times smaller:
            # d distorted = even d plane + odd conj(d plane).
            square = plane.real**2 + plane.imag**2
            slope = self._k1 + square * (2 * self._k2 + 3 * square * self._k3)
            even, odd = self._radial_factor(square) + square * slope, plane * plane * slope
            error = self._apply_distortion(plane) - distorted
            determinant = even * even - odd.real**2 - odd.imag**2
            step = even * error - odd * error.conj()
            plane = plane - step / np.where(np.abs(determinant) > 1e-9, determinant, np.inf)
        error = np.abs(self.distort(plane) - pixels)
        if bool(((error <= MAX_ERROR_PX) & (np.abs(plane) <= self.camera.valid_radius)).all()):
            return plane
        # Some points lie outside the valid radius or near it, where the slower method of the camera is more robust.
        given = self.camera.matrix.new_tensor(np.stack([pixels.real, pixels.imag], -1).tolist())
        points = self.camera.undistort(given).detach().cpu().numpy()
        return points[:, 0] + 1j * points[:, 1]

    def _radial_factor(self, square: np.ndarray) -> np.ndarray:
        return 1 + square * (self._k1 + square * (self._k2 + square * self._k3 if self._k3 else self._k2))

    def _apply_distortion(self, plane: Points) -> Points:
        x, y = plane.real, plane.imag
        square = x * x + y * y
        radial = self._radial_factor(square)
        if self._p1 or self._p2:
            radial += (plane * complex(2 * self._p2, -2 * self._p1)).real
            return plane * radial + complex(self._p2, self._p1) * square
        return plane * radial
