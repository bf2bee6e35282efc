"""Alignment in the view: users put the catheter on its virtual twin; the camera's place on the headset follows."""

import csv
import io
import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from holotorch.experiments.streaming.stream import Frame
from holotorch.experiments.tracking.devices import save_headset
from holotorch.experiments.tracking.headset import COLUMNS, alignment_text
from holotorch.io.files import write_bytes, write_text
from holotorch.tracking.pose.alignment import (
    HAND_LENGTH,
    SAME_DIRECTION,
    Alignment,
    headset_from_camera,
    tool_points,
    widest_angle,
)
from holotorch.tracking.pose.status import Pose
from holotorch.tracking.streaming.packet import now

_FRESH = 0.25  # seconds: largest age of the pose that belongs to an alignment
_FEWEST, _MOST = 3, 100  # alignments that are needed, and that are kept
_FARTHEST = 10.0  # metres from the headset to the virtual catheter


class Aligner:
    """The frame of the poses that a page shows: the camera's, until a user has aligned it with a headset.

    It is called with each pose, keeps the newest one, and returns the pose in the present frame: that of the file, if
    there is one, and of the newest fit otherwise. All alignments are also written to a table beside the file as they
    are made, which ``holotorch calibrate headset`` reads; its axes are RDF.

    Args:
        out: File for the map, see ``devices.HeadsetSettings``. An existing one is used until it is replaced, and kept
            as ``NAME.before.yaml`` then.

    Raises:
        ConfigError: ``out`` exists and is no such file.
    """

    def __init__(self, out: Path):
        self.out = out
        self.frame = Frame.of(out if out.is_file() else None)
        self._alignment: Alignment | None = None
        self._pairs: list[Tensor] = []  # [12] each, as COLUMNS
        self._newest: tuple[float, Pose] | None = None

    @property
    def name(self) -> str:
        """Name of the present frame."""
        return self.frame.name

    @property
    def matrix(self) -> Tensor | None:
        """Map [4, 4] from the camera to the present frame; None for the camera's own."""
        return self.frame.matrix

    @property
    def covariance(self) -> Tensor | None:
        """Covariance [6, 6] of the map, see ``Alignment``."""
        return self.frame.covariance

    def __call__(self, pose: Pose) -> Pose:
        """A pose of the camera's frame in the present frame."""
        self._newest = now(), pose
        return self.frame(pose)

    def answer(self, message: dict[str, Any]) -> dict[str, Any]:
        """Process a message of a page and return the answer.

        The message is ``aligned`` with the ``tip`` [3] in metres and the ``direction`` [3] of the virtual catheter in
        the headset's frame, ``undo`` for the last alignment, or ``save``. The answer has the number of alignments, a
        text, the error of a refusal, and the file that was written.

        Raises:
            ValueError, TypeError, KeyError: The message is none of these.
        """
        saved = ""
        try:
            if message["kind"] == "aligned":
                tip, direction = _vector(message["tip"], _FARTHEST), _vector(message["direction"], 2.0)
                error = self._take(tip, direction) or self._solve()
            elif message["kind"] == "undo":
                del self._pairs[-1:]
                error = self._solve()
            elif message["kind"] == "save":
                error = "" if self._alignment is not None else f"nothing to save yet: {self._solve() or 'align first'}"
                saved = "" if self._alignment is None else self._save(self._alignment)
            else:
                raise ValueError(f"unknown kind {message['kind']!r}")
        except OSError as failed:
            error = f"{failed.filename}: {failed.strerror}"
        return {"kind": "alignment", "count": len(self._pairs), "error": error, "saved": saved} | self._quality()

    def _take(self, tip: Tensor, direction: Tensor) -> str:
        """Add an alignment with the newest pose; returns why that is impossible, or an empty text."""
        if not direction.norm() > 1e-6:
            raise ValueError("the direction is a null vector")
        if self._newest is None or now() - self._newest[0] > _FRESH:
            return "no pose arrives: is the tracker running?"
        pose = self._newest[1]
        if not pose.answered:
            return f"the camera does not see the catheter ({pose.reason or 'refused'}); hold its bands into the picture"
        if len(self._pairs) == _MOST:
            return f"{_MOST} alignments are enough; save them"
        tool = (pose.tip, pose.direction, tip, direction / direction.norm())
        self._pairs.append(torch.cat([part.detach().to("cpu", torch.float64) for part in tool]))
        return ""

    def _solve(self) -> str:
        """Fit the map to all alignments and write their table; returns what is missing for a fit, or an empty text."""
        self._alignment = None
        pairs = torch.stack(self._pairs) if self._pairs else torch.zeros(0, 12, dtype=torch.float64)
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([COLUMNS, *([repr(v) for v in row] for row in pairs.tolist())])
        write_text(self.out.with_suffix(".csv"), text.getvalue())
        if len(pairs) > 1 and widest_angle(pairs[:, 3:6]) < SAME_DIRECTION:
            return "all alignments are parallel: turn the catheter by about 40 degrees before the next one"
        if len(pairs) < _FEWEST:
            return ""
        try:
            camera = tool_points(pairs[:, 0:3], pairs[:, 3:6], HAND_LENGTH)
            headset = tool_points(pairs[:, 6:9], pairs[:, 9:12], HAND_LENGTH)
            self._alignment = headset_from_camera(camera, headset)
        except ValueError as error:
            return f"{error}; turn the catheter by about 40 degrees, or undo"
        names = "headset_from_tool", "ToolToHeadset"
        self.frame = Frame(*names, self._alignment.headset_from_camera, self._alignment.covariance)
        return ""

    def _quality(self) -> dict[str, Any]:
        if self._alignment is None:
            needed = max(0, _FEWEST - len(self._pairs))
            return {"solved": False, "text": f"{len(self._pairs)} alignments, {needed} more are needed"}
        points = torch.stack(self._pairs)
        headset = tool_points(points[:, 6:9], points[:, 9:12], HAND_LENGTH)
        left_out = [value if math.isfinite(value) else None for value in self._alignment.leave_one_out.tolist()]
        rms = float(self._alignment.residuals.square().mean().sqrt())
        return {
            "solved": True,
            "rms": rms,
            "left_out": left_out,
            "text": alignment_text(self._alignment, headset),
        }

    def _save(self, alignment: Alignment) -> str:
        if self.out.is_file():
            write_bytes(self.out.with_suffix(f".before{self.out.suffix}"), self.out.read_bytes())
        save_headset(self.out, alignment)
        return str(self.out)


def _vector(values: Any, longest: float) -> Tensor:
    """Three finite numbers of a message, float64 [3]."""
    if not isinstance(values, list) or len(values) != 3:
        raise ValueError("expected three numbers")
    vector = torch.tensor([float(value) for value in values], dtype=torch.float64)
    if not bool(vector.isfinite().all()) or float(vector.norm()) > longest:
        raise ValueError("a number is not finite or too large")
    return vector
