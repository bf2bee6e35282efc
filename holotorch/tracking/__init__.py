"""Pose of a catheter whose tip is hidden, from the frames of one camera that observes its coloured bands."""

from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.camera.tone import tone_curve
from holotorch.tracking.detection.channels import ChannelOrder, ambiguities
from holotorch.tracking.detection.tracker import CatheterTracker
from holotorch.tracking.pose.alignment import headset_from_camera, in_frame
from holotorch.tracking.pose.band_edges import fit_band_edges
from holotorch.tracking.pose.catheter import THESIS, Catheter
from holotorch.tracking.pose.pose import closed_form, solve_pose
from holotorch.tracking.pose.smoothing import OneEuro
from holotorch.tracking.pose.status import Pose, Status
from holotorch.tracking.refinement.photometric import PhotometricFit
from holotorch.tracking.streaming.stream import PoseReceiver, PoseSender
from holotorch.tracking.thesis.tracker import ThesisTracker

__all__ = [
    "THESIS",
    "Camera",
    "Catheter",
    "CatheterTracker",
    "ChannelOrder",
    "OneEuro",
    "PhotometricFit",
    "Pose",
    "PoseReceiver",
    "PoseSender",
    "Status",
    "ThesisTracker",
    "ambiguities",
    "closed_form",
    "fit_band_edges",
    "headset_from_camera",
    "in_frame",
    "solve_pose",
    "tone_curve",
]
