"""Synthetic trials of a tracker: hard conditions, occlusions, and frames without the catheter."""

import colorsys
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from holotorch.core import checks
from holotorch.tracking.pose.catheter import Catheter
from holotorch.tracking.simulation import scenery
from holotorch.tracking.simulation.look import Look, Occluder
from holotorch.tracking.simulation.render import render
from holotorch.tracking.simulation.world import Case, World, aimed

_TILT = math.radians(20)  # default tilt of the rear to the camera
_DEPTH = 0.52  # metres: default distance of the middle of the bands
_KINDS = ("bare", "papers", "wrong order", "photograph", "other colours")
_KINDS += ("clutter", "unequal bands", "texture", "thick", "hand")


def conditions(world: World) -> list[Case]:
    """One case for each of many difficult conditions: motion, blur, noise, light, slant, distance and clutter.

    Unless the name says otherwise, the rear is tilted by 20 degrees to the camera and the bands' middle 0.52 m away.
    """
    size, bands = world.size, world.catheter.colours
    pose = world.pose(_DEPTH, _TILT)
    along = _image_direction(world, pose)
    cases = []
    for name, step in (("along", along), ("across", np.array([-along[1], along[0]]))):
        for path in (2, 5, 10, 20):
            motion = (float(path * step[0]), float(path * step[1]))
            clear = name == "along" or path < 20
            why = f"moves {path} pixels {name} the axis" + ("" if clear else ", several times the tube's width")
            cases.append(world.case(f"motion {name} {path} px", pose, None, why, answerable=clear, motion_px=motion))
    looks: tuple[tuple[str, dict[str, Any]], ...] = (
        ("plain", {}),
        ("defocus 3 px", {"blur_px": 3.0}),
        ("video 4:2:0", {"video": True}),
        ("jpeg 90", {"jpeg_quality": 90}),
        ("jpeg 60", {"jpeg_quality": 60}),
        ("noise 12", {"noise_dn": 12.0}),
        ("gain 0.25", {"gain": 0.25}),
        ("gain 1.8", {"gain": 1.8}),
        ("highlight", {"highlight": 1.5, "highlight_width": 0.1}),
        ("light from one side", {"ramp": (0.5, 0.3), "ambient": 0.2, "light": (1.0, -0.3, -0.2)}),
    )
    cases += [world.case(name, pose, None, "all edges show", **changes) for name, changes in looks]
    for tilt in (45, 60, 75):
        why = "all edges show" if tilt < 75 else "so slanted that the bands do not tell the depth"
        steep = world.pose(_DEPTH, math.radians(tilt))
        cases.append(world.case(f"tilt {tilt}", steep, None, why, answerable=tilt < 75))
    distant, why = world.pose(1.2, _TILT), "so far that the bands do not tell the depth"
    cases.append(world.case("1200 mm away", distant, None, why, answerable=False))
    cases += _partly_outside(world)
    tip, why = torch.tensor([0.02, 0.01, 0.75], dtype=torch.float64), "points at the camera: no edge shows"
    cases.append(world.case("line of sight", (tip, -tip / tip.norm()), None, why, answerable=False))
    seed = world.seed
    backgrounds: dict[str, Callable[[], Tensor]] = {
        f"cloth as band {i}": partial(scenery.drape, size, seed + i, colour) for i, colour in enumerate(bands, 1)
    }
    backgrounds["skin"] = partial(scenery.skin, size, seed)
    backgrounds["clutter"] = partial(scenery.clutter, size, seed, bands)
    backgrounds["heavy clutter"] = partial(scenery.clutter, size, seed, bands, 4.0)
    backgrounds["texture"] = partial(scenery.texture, size, seed)
    for i, image in enumerate(world.photographs):
        backgrounds[f"photograph {i}"] = partial(scenery.photograph, image, size, seed + i)
    for name, glove in (("white", scenery.WHITE_GLOVE), ("blue", scenery.BLUE_GLOVE)):
        backgrounds[f"{name} glove behind"] = partial(_hand_behind, world, pose, glove)
    return cases + [world.case(name, pose, make, "all edges show") for name, make in backgrounds.items()]


def occlusions(world: World, count: int = 1) -> list[Case]:
    """A finger over parts of the bands, at ``count`` poses: within a band, over a band, over inner and outer edges.

    A case is answerable if all three edges of two neighbouring bands are visible.
    """
    rng, edges, cases = np.random.default_rng(world.seed), world.catheter.edges, []
    ends, last = (edges[0] - 0.015, edges[-1] + 0.015), len(edges) - 1
    spans = {}
    for i, (start, end) in enumerate(itertools.pairwise(edges), 1):
        length = end - start
        spans[f"within band {i}"] = (start + 0.3 * length, end - 0.3 * length)
        spans[f"over band {i}"] = (start - 0.1 * length, end + 0.1 * length)
    spans |= {f"over edge {i}": (edges[i] - 0.006, edges[i] + 0.006) for i in range(1, last)}
    for over in (0.002, 0.005, 0.010, 0.020):
        spans[f"over edge 0 by {1e3 * over:.0f} mm"] = (ends[0], edges[0] + over)
        spans[f"over edge {last} by {1e3 * over:.0f} mm"] = (edges[-1] - over, ends[1])
    spans["over all but band 1"] = (edges[1] - 0.003, ends[1])
    colours = itertools.cycle((scenery.SKIN, scenery.WHITE_GLOVE, scenery.BLUE_GLOVE))
    for i, (name, hidden) in itertools.product(range(checks.whole("count", count, 1)), spans.items()):
        pose = world.pose(rng.uniform(0.42, 0.56), math.radians(rng.uniform(5, 30)), rng.uniform(0, 2 * math.pi))
        answerable, why = _answerable(edges, hidden)
        finger = _finger(world, pose, hidden, next(colours))
        cases.append(world.case(f"{name}, {i}", pose, None, why, answerable=answerable, occluders=finger))
    return cases


def negatives(world: World, count: int) -> list[Case]:
    """``count`` frames without the catheter, of ten kinds in turn, which no tracker may answer.

    They show bare backgrounds, sheets of paper in the bands' colours, photographs, clutter, hands, or catheters that
    differ in one property: the order of the colours (but not reversed, since a reversed catheter looks like the
    catheter in a reversed pose), the colours, the length of a band, or the thickness.
    """
    cases = []
    for i in range(checks.whole("count", count, 1)):
        rng, kind = np.random.default_rng([world.seed, i]), _KINDS[i % len(_KINDS)]
        stick = _stick(world.catheter, kind, rng)
        pose: tuple[Tensor, Tensor] | None = None
        changes: dict[str, Any] = {}
        if stick is not None:
            at = (rng.uniform(-0.2, 0.2), rng.uniform(-0.1, 0.1))
            pose = world.pose(rng.uniform(0.4, 0.7), rng.uniform(-0.6, 0.6), rng.uniform(0, 2 * math.pi), at)
        if kind == "hand":
            at = (rng.uniform(0.3, 0.7) * world.size[1], rng.uniform(0.3, 0.7) * world.size[0])
            colour = (scenery.SKIN, scenery.WHITE_GLOVE, scenery.BLUE_GLOVE)[int(rng.integers(3))]
            radius = rng.uniform(15, 35) * world.size[1] / 1920
            changes["occluders"] = scenery.hand(at, rng.uniform(0, 2 * math.pi), radius, colour)
        name, why, background = f"negative {i}, {kind}", f"no catheter: {kind}", _background(world, kind, i, rng)
        cases.append(world.case(name, pose, background, why, answerable=False, shown=stick, **changes))
    return cases


def _image_direction(world: World, pose: tuple[Tensor, Tensor]) -> np.ndarray:
    """Unit vector [2] of the axis in the frame, at the middle of the bands."""
    tip, direction = pose
    edges = world.catheter.edges
    middle = (edges[0] + edges[-1]) / 2
    start, end = world.camera.project(tip + torch.tensor([[middle - 1e-3], [middle + 1e-3]]) * direction).numpy()
    return (end - start) / np.linalg.norm(end - start)


def _partly_outside(world: World) -> list[Case]:
    """Cases of a catheter whose rear or tip lies outside the frame, with the right border in the middle of a band."""
    edges, cases = world.catheter.edges, []
    border = torch.tensor([world.size[1] - 1.0, world.size[0] / 2], dtype=torch.float64)
    ray = torch.cat([world.camera.undistort(border), torch.ones(1, dtype=torch.float64)])
    last = len(edges) - 1
    for band, roll in ((last, 25), (last - 1, 25), (1, 205), (2, 205)):
        direction = aimed(_TILT, math.radians(roll))
        cut = (edges[band - 1] + edges[band]) / 2
        hidden = (cut, math.inf) if roll == 25 else (-math.inf, cut)
        answerable, why = _answerable(edges, hidden)
        name = f"{'rear' if roll == 25 else 'tip'} out of frame from band {band}"
        cases.append(world.case(name, (_DEPTH * ray - cut * direction, direction), None, why, answerable=answerable))
    return cases


def _hand_behind(world: World, pose: tuple[Tensor, Tensor], colour: scenery.Colour) -> Tensor:
    """Background of a desk and a hand behind the bands."""
    tip, direction = pose
    middle = tip + (world.catheter.edges[1] + world.catheter.edges[2]) / 2 * direction
    x, y = world.camera.project(middle).tolist()
    radius = 24 * world.size[1] / 1920
    hand = scenery.hand((x - 2 * radius, y - 4 * radius), 1.3, radius, colour)
    look = Look(world.desk(), noise_dn=0.0, occluders=hand)
    return render(None, world.camera, None, None, world.size, look)


def _finger(
    world: World, pose: tuple[Tensor, Tensor], span: tuple[float, float], colour: scenery.Colour
) -> tuple[Occluder, ...]:
    """A finger across the tube that hides ``span``, in metres from the tip."""
    tip, direction = pose
    start, end = world.camera.project(tip + torch.tensor(span, dtype=torch.float64)[:, None] * direction).numpy()
    width = float(np.linalg.norm(end - start))
    across = np.array([-(end - start)[1], (end - start)[0]]) / width
    # The round end begins beyond the tube, so that the finger's sides are straight where they cross the tube.
    first = (start + end) / 2 - (width / 8 + 8) * across
    return scenery.finger(tuple(first.tolist()), tuple((first + 1200 * across).tolist()), width / 2, colour)


def _answerable(edges: Sequence[float], hidden: tuple[float, float]) -> tuple[bool, str]:
    """Whether three edges in a row are visible, 2 mm or more outside the ``hidden`` span, and the reason."""
    visible = [not hidden[0] - 0.002 <= edge <= hidden[1] + 0.002 for edge in edges]
    for i in range(1, len(edges) - 1):
        if all(visible[i - 1 : i + 2]):
            return True, "all edges show" if all(visible) else f"bands {i} and {i + 1} show all their edges"
    return False, f"{sum(visible)} of {len(visible)} edges show, but no three in a row"


def _stick(catheter: Catheter, kind: str, rng: np.random.Generator) -> Catheter | None:
    """A similar object that is not the catheter; None for kinds without such an object."""
    edges, colours = np.array(catheter.edges), catheter.colours
    if kind == "wrong order":
        orders = [order for order in itertools.permutations(colours) if order not in (colours, colours[::-1])]
        orders = [order for order in orders if all(math.dist(*pair) > 40 for pair in itertools.pairwise(order))]
        return replace(catheter, colours=orders[int(rng.integers(len(orders)))]) if orders else None
    if kind == "other colours":
        shifted = (tuple(_shift_hue(colour, turn) for colour in colours) for turn in (1 / 6, 1 / 2, 5 / 6))
        distinct = max(shifted, key=lambda others: min(math.dist(a, b) for a in colours for b in others))
        return replace(catheter, colours=distinct)
    if kind == "unequal bands":
        # Not an outer band: with another length it looks nearly like equal bands at another slant.
        band = int(rng.integers(1, len(colours) - 1))
        edges[band + 1 :] += (edges[band + 1] - edges[band]) * (0.7 if rng.random() < 0.5 else -0.5)
        return replace(catheter, edges=tuple(edges.tolist()), length=max(catheter.length, float(edges[-1]) + 0.05))
    if kind == "thick":
        return replace(catheter, radius=min(rng.uniform(3, 5) * catheter.radius, 0.45 * float(np.diff(edges).min())))
    return None


def _shift_hue(colour: scenery.Colour, turn: float) -> scenery.Colour:
    """The colour with its hue shifted by a fraction ``turn`` of the hue circle."""
    hue, saturation, value = colorsys.rgb_to_hsv(*(level / 255 for level in colour))
    red, green, blue = (round(255 * level) for level in colorsys.hsv_to_rgb((hue + turn) % 1, saturation, value))
    return red, green, blue


def _background(world: World, kind: str, i: int, rng: np.random.Generator) -> Callable[[], Tensor]:
    """Function that makes the background of frame ``i`` without the catheter."""
    size, bands, seed = world.size, world.catheter.colours, world.seed + 7919 * (i + 1)
    blue = ((60, 120, 180), (40, 70, 190), (60, 140, 110))[int(rng.integers(3))]
    photographs, which = world.photographs, int(rng.integers(max(len(world.photographs), 1)))
    if kind == "papers":
        return partial(scenery.papers, size, seed, bands)
    if kind == "clutter":
        return partial(scenery.clutter, size, seed, bands, float(rng.uniform(0.5, 4)))
    if kind == "photograph" and photographs:
        return partial(scenery.photograph, photographs[which], size, seed)
    if kind in ("photograph", "texture"):
        return partial(scenery.texture, size, seed)
    options = (scenery.desk, partial(scenery.drape, colour=blue), scenery.skin)
    return partial(options[(i // len(_KINDS) + int(rng.integers(2))) % 3], size, seed)
