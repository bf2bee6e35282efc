"""Viewer: what the page asks of a run, and what it shows."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from holotorch.experiments.view.controls import Control
from holotorch.io.images import encode_png


class Outdated(Exception):
    """The page has asked for something else in the meantime."""


@dataclass(frozen=True)
class Picture:
    """A picture with its caption."""

    name: str  # such as "shown"; a page replaces the picture of the same name
    caption: str
    png: bytes

    @classmethod
    def of(cls, name: str, caption: str, image: Tensor) -> "Picture":
        """The picture of an image [C, H, W] with values from 0 to 1, which are clipped."""
        return cls(name, caption, encode_png(image.float()))


@dataclass(frozen=True)
class Shown:
    """Pictures for values of the controls.

    Attributes:
        pictures: The pictures, in order.
        numbers: Names and values in words.
        coarse: Whether less was computed than for a picture at rest.
    """

    pictures: Sequence[Picture]
    numbers: Mapping[str, str]
    coarse: bool = False


class Viewer(ABC):
    """A finished run whose pictures depend on the values of controls. One thread at a time uses it.

    Attributes:
        title: Heading of the page.
        controls: What the user chooses. If ``azimuth`` and ``elevation`` are among them, dragging a picture turns the
            volume.
        note: Sentences below the pictures: how they are computed.
        transforms: Shape [..., H, W] of the transforms behind a picture, which its time is compared with.
    """

    title: str
    controls: Sequence[Control]
    note: str
    transforms: tuple[int, ...]

    @abstractmethod
    def show(self, values: Mapping[str, Any], coarse: bool, proceed: Callable[[], None]) -> Shown:
        """The pictures for checked values of all controls.

        Args:
            values: By the names of the controls.
            coarse: Whether the user is still moving a control, so that a fast picture is better than a fine one.
            proceed: To be called during long work; raises :class:`Outdated` if the result is no longer wanted.

        Raises:
            ValueError, MemoryError: There is no such picture, in one line.
        """


def percent(share: float) -> str:
    """A share in words."""
    return f"{100 * share:.3g} %"
