"""Order of a frame's colour channels, and which exchanges of them a catheter's bands survive as another pose."""

import warnings
from collections.abc import Sequence
from enum import Enum

import torch
from torch import Tensor

from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.detection.colours import ColourTable
from holotorch.tracking.pose.catheter import Catheter

_EDGES = 3  # that a tracker answers with a pose
_MARGIN = 8.0  # degrees of hue by which shading, gloss and a codec move a colour


class ChannelOrder(Enum):
    """What the channels of a frame [..., 3, H, W] are: BGR as OpenCV gives them, RGB as the readers of holotorch do."""

    RGB = "RGB"
    RBG = "RBG"
    GRB = "GRB"
    GBR = "GBR"
    BRG = "BRG"
    BGR = "BGR"

    def to_rgb(self, frames: Tensor) -> Tensor:
        """Frames [..., 3, H, W] of this order as red, green and blue; the same tensor where they are."""
        if self is ChannelOrder.RGB:
            return frames
        return frames[..., [self.value.index(name) for name in "RGB"], :, :]


class ChannelOrderWarning(UserWarning):
    """Frames in another order of channels would show another pose, and nobody has said which order they have."""


def need_frames(frames: Tensor) -> None:
    """TypeError or ValueError unless ``frames`` is a tensor of uint8 [B, 3, H, W]."""
    if not isinstance(frames, Tensor):
        raise TypeError(f"frames must be a torch tensor, uint8 of shape [B, 3, H, W], got {type(frames).__name__}")
    if frames.ndim != 4 or frames.shape[1] != 3 or frames.dtype != torch.uint8:
        raise ValueError(f"frames must be uint8 of shape [B, 3, H, W], got {frames.dtype}, {list(frames.shape)}")


def stated_order(channels: ChannelOrder | None, camera: Camera, catheter: Catheter) -> ChannelOrder:
    """The order that a tracker's user has stated; else RGB, with a warning where the catheter cannot confirm it."""
    if channels is None:
        if text := ambiguity_text(ambiguities(camera, catheter)):
            text += (
                "; to state the order, write CatheterTracker(..., channels=ChannelOrder.RGB), or BGR as OpenCV gives"
            )
            warnings.warn(text, ChannelOrderWarning, stacklevel=3)
        return ChannelOrder.RGB
    if not isinstance(channels, ChannelOrder):
        raise TypeError(f"channels must be a ChannelOrder, such as ChannelOrder.BGR, got {channels!r}")
    return channels


def ambiguities(camera: Camera, catheter: Catheter) -> tuple[ChannelOrder, ...]:
    """Channel orders whose frames, taken for RGB, may show the bands where they are not.

    With the thesis's red, green and blue bands that is BGR: red and blue change places, and the bands read as the same
    ones from the other end. Read so, three bands fit a pose whatever their lengths are (the cross-ratio of four edges
    is the same in reverse), and only the tube's width may contradict it, or the lengths of tube beyond the bands where
    they lie on the frame (:func:`~holotorch.tracking.detection.ends.shows_reversed`); so the colours must tell.

    A mirrored frame is not among these: of a straight tube it is a possible frame, with any colours and lengths, and
    only the scene beside the tube tells.

    Args:
        camera: Of whose frames; its tone curve says what hue levels have.
        catheter: As :class:`CatheterTracker` takes it.

    Returns:
        The orders that leave at least three edges with the catheter's own colours on both sides, in the catheter's
        sequence from either end. Empty for a catheter that no exchange of channels turns into a wrong pose.

    Raises:
        ValueError: Colours that no tracker can tell apart, as for ``CatheterTracker``.
    """
    table = ColourTable(camera, catheter)
    bands = [{label} for label in table.bands]
    wanted = _borders(bands)
    found = []
    for order in list(ChannelOrder)[1:]:
        shown = torch.tensor([[colour["RGB".index(name)] for name in order.value] for colour in catheter.colours])
        labels = [set(each) for each in table.alike(shown, _MARGIN)]
        if labels == bands:
            continue  # the exchange changes nothing
        onward = _borders(labels)
        backward = [(after, before) for before, after in reversed(onward)]
        if max(_common(wanted, onward), _common(wanted, backward)) >= _EDGES:
            found.append(order)
    return tuple(found)


def ambiguity_text(orders: Sequence[ChannelOrder]) -> str:
    """What a user should know of such orders, and what to do; empty where there are none."""
    names = " or ".join(order.value for order in orders)
    return names and (
        f"frames with channels in the order {names} show this catheter's bands as another pose, with a small stated "
        "deviation, and only the tube beyond its bands tells, where it is on the frame: make sure that what is red is "
        "red in the frames, or paint bands that no exchange of channels makes the same, as in "
        "configs/tracking/catheter_distinct.yaml"
    )


_Border = tuple[set[int], set[int]]
_NONE = -1  # where a band's colour is none of the catheter's, and beyond the bands


def _borders(labels: Sequence[set[int]]) -> list[_Border]:
    """What each edge has before and after it."""
    padded = [{_NONE}, *labels, {_NONE}]
    return list(zip(padded, padded[1:], strict=False))


def _common(wanted: Sequence[_Border], shown: Sequence[_Border]) -> int:
    """Longest common subsequence: edges that are seen with the colours wanted, in their order."""
    best = [0] * (len(shown) + 1)
    for before, after in wanted:
        row = [0]
        for i, (left, right) in enumerate(shown):
            row.append(best[i] + 1 if before & left and after & right else max(row[i], best[i + 1]))
        best = row
    return best[-1]
