"""Where the hidden tip of a catheter is, from one camera that sees its coloured bands."""

from holotorch.tracking.camera import Camera
from holotorch.tracking.catheter import THESIS, Catheter
from holotorch.tracking.pose import closed_form, solve_pose
from holotorch.tracking.status import Pose, Status
from holotorch.tracking.thesis import ThesisTracker
from holotorch.tracking.tracker import CatheterTracker

__all__ = [
    "THESIS",
    "Camera",
    "Catheter",
    "CatheterTracker",
    "Pose",
    "Status",
    "ThesisTracker",
    "closed_form",
    "solve_pose",
]
