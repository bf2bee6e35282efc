"""Where the hidden tip of a catheter is, from one camera that sees its coloured bands."""

from holotorch.tracking.alignment import headset_from_camera
from holotorch.tracking.band_edges import fit_band_edges
from holotorch.tracking.camera import Camera
from holotorch.tracking.catheter import THESIS, Catheter
from holotorch.tracking.channels import ChannelOrder, ambiguities
from holotorch.tracking.pose import closed_form, solve_pose
from holotorch.tracking.smoothing import OneEuro
from holotorch.tracking.status import Pose, Status
from holotorch.tracking.stream import PoseReceiver, PoseSender
from holotorch.tracking.thesis import ThesisTracker
from holotorch.tracking.tone import tone_curve
from holotorch.tracking.tracker import CatheterTracker

__all__ = [
    "THESIS",
    "Camera",
    "Catheter",
    "CatheterTracker",
    "ChannelOrder",
    "OneEuro",
    "Pose",
    "PoseReceiver",
    "PoseSender",
    "Status",
    "ThesisTracker",
    "ambiguities",
    "closed_form",
    "fit_band_edges",
    "headset_from_camera",
    "solve_pose",
    "tone_curve",
]
