"""``holotorch calibrate catheter``: the file of a catheter from its lengths and a photograph of its bands."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import torch
from torch.nn import functional

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.runs.figures import pixel_lines
from holotorch.experiments.tracking.devices import build_catheter, load_catheter, save_catheter
from holotorch.io.bundled import find_config
from holotorch.io.files import write_bytes
from holotorch.io.images import encode_png, load_image, with_channels
from holotorch.io.video import PICTURES, open_frames
from holotorch.tracking import Camera, Catheter
from holotorch.tracking.detection.channels import ambiguities, ambiguity_text
from holotorch.tracking.detection.colours import ColourTable

GEOMETRY = "configs/tracking/catheter.yaml"  # whose edges, radius and length are kept unless another file is named
_AROUND = 2  # pixels to each side of a position that may count too
_SURROUNDINGS = 6  # pixels to each side of a position; those on the border of this square are compared with the band
_LIKE_BAND = 0.7  # of the largest difference from the surroundings: from here on, a pixel counts as one of the band
_FEW = 4  # pixels: where fewer about a position look like the band, the position probably lies beside it
_SHOWN, _TILE = 20, 240  # pixels: the picture shows so many to each side of a place, in squares of so many
_ACROSS = 0.5  # of the distance to the nearest band's place: where a colour continues so wide, it is no tube's
_SAME, _SAME_LEAST = 0.4, 12  # of a colour's chroma, and levels: a pixel whose chroma differs by less shows this colour
_UNEVEN = 25  # levels: deviation within a box above which it probably holds more than one band
_THIN = 0.3e-3  # metres: radius below which a unit is probably wrong; the thinnest catheters are near it
_BRIGHT = 250  # level from which on a channel is probably saturated
_STAND_INS = ((200, 40, 45), (40, 70, 190))  # colours of neighbouring bands until theirs are read
_PLACE = re.compile(r"(\d{1,5}),(\d{1,5})(?:,(\d{1,5}),(\d{1,5}))?")


def calibrate_catheter(
    photograph: Path,
    places: Sequence[str],
    out: Path,
    geometry: Path | None = None,
    measured: Mapping[str, str] = MappingProxyType({}),
) -> tuple[Catheter, list[str]]:
    """Read the colours of the bands from a photograph and write the catheter to ``out``.

    Near a position, the pixels whose chroma differs most from the surroundings count, so that a thin tube is not mixed
    with what is behind it; of a box, all do. Their median is the colour.

    Args:
        photograph: A picture, or a video or folder whose first frame is taken, in the light of the later frames.
        places: One for each band, from the tip on: a position X,Y in pixels, or a box X0,Y0,X1,Y1 on the band.
        out: YAML file for the catheter; must not exist yet.
        geometry: YAML file whose edges, radius and length are kept; by default that of the dissertation's catheter.
        measured: Text of ``edges``, ``radius`` or ``length`` as in a file, such as ``[20 mm, 40 mm, 50 mm, 60 mm]``;
            replaces that of the file.

    Returns:
        The catheter, and lines of text about its colours.

    Raises:
        ConfigError: A file or length cannot be used, a place is none or not on the picture, or the colours cannot be
            told apart.
    """
    source = geometry or Path(GEOMETRY)
    overrides = [f"{key}={value}" for key, value in measured.items()]
    if "edges" in measured:  # there may be more bands than in the file, whose colours are replaced below
        bands = measured["edges"].count(",")
        if bands != len(places):
            needed = f"{len(places)} bands have {len(places) + 1} edges: where each begins, and where the last one ends"
            raise ConfigError([f"--edges: {needed}; got {bands + 1}: {measured['edges'][1:-1]}"])
        overrides.append(f"colours={[list(_STAND_INS[i % 2]) for i in range(bands)]}")
    tool = build_catheter(load_catheter(find_config(source) or source, overrides))
    pixels = _pixels(photograph)
    boxes = _boxes(places, len(tool.colours), pixels.shape[-2:])
    if out.exists():
        raise ConfigError([f"{out} exists already; choose another --out or delete it"])
    picture = out.with_name(f"{out.stem}-bands.png")
    if picture.exists():
        raise ConfigError([f"{picture} exists already; choose another --out or delete it"])
    levels, spread, counts = zip(*(_colour(pixels, box) for box in boxes), strict=True)
    camera = Camera(torch.eye(3, dtype=torch.float64), torch.zeros(5, dtype=torch.float64))  # of the tone sRGB
    try:
        catheter = replace(tool, colours=levels)
        ColourTable(camera, catheter)
    except ValueError as error:
        listed = ", ".join(f"{place}: {list(level)}" for place, level in zip(places, levels, strict=True))
        advice = "do X (to the right) and Y (downwards) lie on the bands? Photograph them in even light without gloss"
        raise ConfigError([f"{photograph}: {error}; found {listed}: {advice}"]) from None
    out.parent.mkdir(parents=True, exist_ok=True)
    save_catheter(out, catheter, photograph.name)
    write_bytes(picture, encode_png(_places_shown(pixels, boxes, levels) / 255))
    lines = [
        f"Band {i}     [{', '.join(map(str, level))}] at {place}, median of {count} pixels, which deviate by "
        f"{deviation:.0f} levels"
        for i, (level, place, deviation, count) in enumerate(zip(levels, places, spread, counts, strict=True), 1)
    ]
    edges = ", ".join(f"{1e3 * edge:g}" for edge in tool.edges)
    kept = [key for key in ("edges", "radius", "length") if key not in measured]
    lines.append(
        f"Geometry   edges at {edges} mm from the tip, radius {1e3 * tool.radius:g} mm, length {1e3 * tool.length:g} mm"
        + (f"; {' and '.join(kept)} of {source}: measure yours and give --{' --'.join(kept)}" if kept else "")
    )
    notes = _notes(places, boxes, levels, spread, counts) + _beside(places, boxes, levels, pixels)
    if tool.radius < _THIN:
        notes.append(f"a tube of {2e3 * tool.radius:g} mm is thin: is the unit of its lengths right?")
    if doubt := ambiguity_text(ambiguities(camera, catheter)):
        notes.append(doubt)
    shown = (
        f"Picture    {picture}: around each place, in a frame the pixels that may count, below the colour that was read"
    )
    return catheter, [*lines, shown, *(f"Note       {note}" for note in notes)]


def _notes(
    places: Sequence[str],
    boxes: Sequence[tuple[int, int, int, int]],
    levels: Sequence[tuple[int, int, int]],
    spread: Sequence[float],
    counts: Sequence[int],
) -> list[str]:
    """What makes a band's colour doubtful: its place, or its light."""
    notes = [
        f"band {i} varies much within {place}: choose a box that holds this band alone, or a position X,Y on it"
        for i, (place, deviation) in enumerate(zip(places, spread, strict=True), 1)
        if deviation > _UNEVEN
    ]
    notes += [
        f"band {i}: only {count} of the pixels about {place} look like a band; is the position on its middle?"
        for i, (place, count, (x0, y0, x1, y1)) in enumerate(zip(places, counts, boxes, strict=True), 1)
        if count < _FEW and (x0, y0) == (x1, y1)
    ]
    notes += [
        f"band {i} is overexposed, so that its hue may be wrong; use a shorter exposure"
        for i, level in enumerate(levels, 1)
        if max(level) >= _BRIGHT
    ]
    return notes


def _beside(
    places: Sequence[str],
    boxes: Sequence[tuple[int, int, int, int]],
    levels: Sequence[tuple[int, int, int]],
    pixels: torch.Tensor,
) -> list[str]:
    """Bands whose colour does not end across the tube: their place lies beside it.

    The tube runs through all of them. From each, the colour must end on both sides within a part of the distance to the
    next band, which is longer than the tube is wide.
    """
    centres = torch.tensor([((x0 + x1) / 2, (y0 + y1) / 2) for x0, y0, x1, y1 in boxes], dtype=torch.float64)
    along = torch.linalg.svd(centres - centres.mean(0)).Vh[0]
    across = torch.stack([-along[1], along[0]])
    apart = torch.cdist(centres, centres).fill_diagonal_(float("inf")).amin(1)
    smooth = functional.avg_pool2d(pixels.double()[None], 3, 1, 1, count_include_pad=False)[0]
    limits = torch.tensor([smooth.shape[2], smooth.shape[1]])
    notes = []
    for i, (place, centre, level, width) in enumerate(zip(places, centres, levels, apart.tolist(), strict=True), 1):
        steps = torch.arange(round(_ACROSS * width) + 1, dtype=torch.float64)[:, None]
        wanted = torch.tensor(level, dtype=torch.float64) - sum(level) / 3
        for side in (across, -across):
            x, y = (line := (centre + steps * side).round().long()).unbind(1)
            if len(line) == 1 or not ((line >= 0) & (line < limits)).all():
                continue  # nothing to judge by
            chroma = smooth[:, y, x].T - smooth[:, y, x].mean(0)[:, None]
            if ((chroma - wanted).norm(dim=1) < max(_SAME_LEAST, _SAME * float(wanted.norm()))).all():
                notes.append(
                    f"band {i}: the colour at {place} continues for {len(line) - 1} pixels to one side, as that of "
                    "something behind the tube would: does the place lie on the band? Look at the picture"
                )
                break
    return notes


def save_first_frame(video: Path, out: Path) -> str:
    """Write the first frame of a video to ``out``, and one with lines of pixels beside it; say what to do with them.

    ConfigError if it cannot.
    """
    pixels, lined = _pixels(video), out.with_name(f"{out.stem}-pixels.png")
    if existing := [path for path in (out, lined) if path.exists()]:
        raise ConfigError([f"{existing[0]} exists already; choose another --out, or give --bands X,Y X,Y X,Y"])
    write_bytes(out, encode_png(pixels / 255))
    write_bytes(lined, pixel_lines(pixels))
    return (
        f"Frame      {out}, {pixels.shape[-1]} x {pixels.shape[-2]} px, and with lines of X and Y {lined}: find a "
        "pixel X,Y of each band, from the tip on, and give --bands X,Y X,Y X,Y"
    )


def _pixels(photograph: Path) -> torch.Tensor:
    """RGB pixels uint8 [3, H, W] of a picture, or of the first frame of a video or folder."""
    try:
        if photograph.suffix.lower() in PICTURES:
            return (with_channels(load_image(photograph), 3) * 255).round().to(torch.uint8)
        with open_frames(photograph) as frames:
            first = next(iter(frames))
    except (ValueError, OSError) as error:
        raise ConfigError([f"{photograph}: {getattr(error, 'strerror', None) or error}"]) from None
    if first.pixels is None:
        raise ConfigError([f"{photograph}: {first.problem}"])
    return first.pixels


def _boxes(places: Sequence[str], bands: int, size: Sequence[int]) -> list[tuple[int, int, int, int]]:
    """Boxes (x0, y0, x1, y1), ends included, of the places. ConfigError with all mistakes."""
    if len(places) != bands:
        raise ConfigError([f"--bands: expected {bands} places, one for each band from the tip on, got {len(places)}"])
    mistakes, boxes = [], []
    for place in places:
        if not (match := _PLACE.fullmatch(place)):
            mistakes.append(f"--bands: expected X,Y or X0,Y0,X1,Y1 in pixels, got {place!r}")
            continue
        x, y = int(match[1]), int(match[2])
        box = (x, y, int(match[3]), int(match[4])) if match[3] else (x, y, x, y)
        if not (box[0] <= box[2] < size[1] and box[1] <= box[3] < size[0]):
            expected = f"places on the picture of {size[1]} x {size[0]} px, X0,Y0 before X1,Y1"
            mistakes.append(f"--bands: expected {expected}, got {place!r}")
        boxes.append(box)
    if mistakes:
        raise ConfigError(mistakes)
    return boxes


def _places_shown(
    pixels: torch.Tensor, boxes: Sequence[tuple[int, int, int, int]], levels: Sequence[tuple[int, int, int]]
) -> torch.Tensor:
    """Levels [3, H, W] of a picture: the surroundings of each box, enlarged, with a frame, above the colour read."""
    tiles = []
    for (x0, y0, x1, y1), level in zip(boxes, levels, strict=True):
        margin = _AROUND if (x0, y0) == (x1, y1) else 0
        half = max(_SHOWN, x1 - x0, y1 - y0)
        left, top = (x0 + x1) // 2 - half, (y0 + y1) // 2 - half
        around = functional.pad(pixels.double(), (half, half, half, half))
        around = around[:, top + half : top + 3 * half + 1, left + half : left + 3 * half + 1].clone()
        frame = torch.zeros(around.shape[1:], dtype=torch.bool)
        frame[y0 - top - margin - 1 : y1 - top + margin + 2, x0 - left - margin - 1 : x1 - left + margin + 2] = True
        frame[y0 - top - margin : y1 - top + margin + 1, x0 - left - margin : x1 - left + margin + 1] = False
        around[:, frame] = 255.0 if around.mean() < 128 else 0.0
        colour = torch.tensor(level, dtype=torch.float64)[:, None, None].expand(3, _TILE // 4, _TILE)
        tile = torch.cat([functional.interpolate(around[None], (_TILE, _TILE))[0], colour], 1)
        tiles.append(functional.pad(tile, (2, 2, 2, 2), value=255.0))
    return torch.cat(tiles, 2)


def _colour(pixels: torch.Tensor, box: tuple[int, int, int, int]) -> tuple[tuple[int, int, int], float, int]:
    """Median colour within a box or about a position, the largest deviation of its channels, number of pixels."""
    x0, y0, x1, y1 = box
    if (x0, y0) == (x1, y1):
        inside = _like_band(pixels, x0, y0)
    else:
        inside = pixels[:, y0 : y1 + 1, x0 : x1 + 1].flatten(1).numpy().astype(np.float64)
    red, green, blue = (int(value) for value in np.median(inside, 1).round())
    return (red, green, blue), float(inside.std(1).max()), inside.shape[1]


def _like_band(pixels: torch.Tensor, x: int, y: int) -> np.ndarray:
    """Levels [3, n] of the pixels around a position whose chroma differs most from its surroundings.

    On a band that is wider than the surroundings, where none differs much, these are all of the pixels.
    """

    def square(radius: int) -> np.ndarray:
        rows, columns = slice(max(0, y - radius), y + radius + 1), slice(max(0, x - radius), x + radius + 1)
        return pixels[:, rows, columns].numpy().astype(np.float64)

    wide, near = square(_SURROUNDINGS), square(_AROUND).reshape(3, -1)
    border = np.concatenate([wide[:, 0], wide[:, -1], wide[..., 0], wide[..., -1]], 1)
    behind = np.median(border - border.mean(0), 1, keepdims=True)
    away = np.linalg.norm(near - near.mean(0) - behind, axis=0)  # gloss, which has no chroma, does not stand out
    return near[:, away >= _LIKE_BAND * away.max()] if away.max() > _UNEVEN else near
