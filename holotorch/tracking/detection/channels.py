"""Order of a frame's colour channels, and wrong orders in which a catheter appears in another, valid pose."""

import warnings
from collections.abc import Sequence
from enum import Enum

import torch
from torch import Tensor

from holotorch.tracking.camera.camera import Camera
from holotorch.tracking.detection.colours import ColourTable
from holotorch.tracking.pose.catheter import Catheter

_EDGES = 3  # least number of visible edges for which the tracker computes a pose
_MARGIN = 8.0  # largest change of a hue by shading, gloss and codecs, in degrees


class ChannelOrder(Enum):
    """Order of the channels of a frame [..., 3, H, W]: BGR in OpenCV, RGB from the readers of holotorch."""

    RGB = "RGB"
    RBG = "RBG"
    GRB = "GRB"
    GBR = "GBR"
    BRG = "BRG"
    BGR = "BGR"

    def to_rgb(self, frames: Tensor) -> Tensor:
        """Frames [..., 3, H, W] of this order with their channels reordered to RGB."""
        if self is ChannelOrder.RGB:
            return frames
        return frames[..., [self.value.index(name) for name in "RGB"], :, :]


class ChannelOrderWarning(UserWarning):
    """The order of the channels is not stated, and frames in another order would show the catheter in another pose."""


def as_levels(frames: Tensor) -> Tensor:
    """Frames uint8 [B, 3, H, W] as they are, and floating ones from 0 to 1, as kornia has them, as 8-bit levels.

    Raises:
        TypeError, ValueError: Another type, shape or range, or frames that require a gradient, which levels cut off.
    """
    if not isinstance(frames, Tensor):
        raise TypeError(f"frames must be a torch tensor of shape [B, 3, H, W], got {type(frames).__name__}")
    if frames.ndim != 4 or frames.shape[1] != 3:
        raise ValueError(f"frames must be of shape [B, 3, H, W], got {list(frames.shape)}")
    if frames.dtype == torch.uint8:
        return frames
    if not frames.is_floating_point():
        raise ValueError(f"frames must be uint8, or floating from 0 to 1, got {frames.dtype}")
    if frames.requires_grad:
        raise TypeError("frames that require a gradient cannot be tracked; refine their poses by PhotometricFit")
    low, high = (float(value) for value in frames.aminmax()) if frames.numel() else (0.0, 0.0)
    if not (low >= 0 and high <= 1):
        raise ValueError(f"floating frames must be from 0 to 1, got {low:g} to {high:g}")
    return (255 * frames).round().to(torch.uint8)


def stated_order(channels: ChannelOrder | None, camera: Camera, catheter: Catheter) -> ChannelOrder:
    """``channels``, or RGB for None, with a ChannelOrderWarning if the catheter has :func:`ambiguities`."""
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
    """Channel orders whose frames, if taken for RGB, may show this catheter in a wrong but valid pose.

    For the red, green and blue bands of the thesis, this is BGR: exchanging red and blue gives the same sequence of
    bands from the other end. Three bands in reversed order fit some pose for any lengths of the bands, because the
    cross-ratio of four edges is the same in reverse. This pose can be refuted only by the width of the tube, or by the
    lengths of the tube beyond the bands if these are on the frame
    (:func:`~holotorch.tracking.detection.ends.shows_reversed`).

    Mirrored frames are not covered: the mirror image of a straight tube is always the image of another pose, for any
    colours and lengths, so that only the scene beside the tube could reveal the mirror.

    Args:
        camera: Camera of the frames; its tone curve determines the hues of levels.
        catheter: Catheter, as for :class:`CatheterTracker`.

    Returns:
        Orders in which at least three edges show the colours of edges of the catheter, in its sequence from either end.
        Empty if no order of channels can cause a wrong pose.

    Raises:
        ValueError: The colours of the bands are grey, too similar, or the same from both ends.
    """
    table = ColourTable(camera, catheter)
    bands = [{label} for label in table.bands]
    wanted = _borders(bands)
    found = []
    for order in list(ChannelOrder)[1:]:
        shown = torch.tensor([[colour["RGB".index(name)] for name in order.value] for colour in catheter.colours])
        labels = [set(each) for each in table.alike(shown, _MARGIN)]
        if labels == bands:
            continue  # this order changes no band's label
        onward = _borders(labels)
        backward = [(after, before) for before, after in reversed(onward)]
        if max(_common(wanted, onward), _common(wanted, backward)) >= _EDGES:
            found.append(order)
    return tuple(found)


def ambiguity_text(orders: Sequence[ChannelOrder]) -> str:
    """Message for the user about ambiguous orders, with a remedy; empty if there are none."""
    names = " or ".join(order.value for order in orders)
    return names and (
        f"frames in the order {names} show this catheter in another pose, which only the tube beyond the bands can "
        "refute: red objects must be red in the frames; bands as in configs/tracking/catheter_distinct.yaml are safe "
        "in every order"
    )


_Border = tuple[set[int], set[int]]
_NONE = -1  # label beyond the bands, and of a colour that no band has


def _borders(labels: Sequence[set[int]]) -> list[_Border]:
    """Possible labels before and after each edge, from the possible labels of each band."""
    padded = [{_NONE}, *labels, {_NONE}]
    return list(zip(padded, padded[1:], strict=False))


def _common(wanted: Sequence[_Border], shown: Sequence[_Border]) -> int:
    """Length of the longest common subsequence of the ``wanted`` and the ``shown`` edges."""
    best = [0] * (len(shown) + 1)
    for before, after in wanted:
        row = [0]
        for i, (left, right) in enumerate(shown):
            row.append(best[i] + 1 if before & left and after & right else max(row[i], best[i + 1]))
        best = row
    return best[-1]
