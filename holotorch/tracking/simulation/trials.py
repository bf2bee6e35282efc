"""Synthetic trials of a tracker: occlusions, hard conditions, and frames in which there is no catheter to find."""

import colorsys
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
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

_TILT = math.radians(20)
_DEPTH = 0.52  # metres, of the middle of the bands
_KINDS = (
    "bare",
    "papers",
    "wrong order",
    "photograph",
    "other colours",
    "clutter",
    "unequal bands",
    "texture",
    "thick",
    "hand",
)


def conditions(world: World) -> list[Case]:
    """One frame for each condition that may trouble a tracker: motion, blur, noise, light, slant, distance, clutter.

    The bands' middle is 0.52 m away and the rear 20 degrees towards the camera unless the name says otherwise.
    """
    size, bands = world.size, world.catheter.colours
    pose = world.pose(_DEPTH, _TILT)
    along = _image_direction(world, pose)
    cases = []
    for way, step in (("along", along), ("across", np.array([-along[1], along[0]]))):
        for path in (2, 5, 10, 20):
            moved = (float(path * step[0]), float(path * step[1]))
            told = way == "along" or path < 20
            why = f"moves {path} pixels {way} the axis" + ("" if told else ", several times the tube's width")
            cases.append(world.case(f"motion {way} {path} px", pose, None, why, answerable=told, motion_px=moved))
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
    far = world.pose(1.2, _TILT)
    cases.append(world.case("1200 mm away", far, None, "so far that the bands do not tell the depth", answerable=False))
    cases += _half_out(world)
    tip = torch.tensor([0.02, 0.01, 0.75], dtype=torch.float64)
    why = "points at the camera: no edge shows"
    cases.append(world.case("line of sight", (tip, -tip / tip.norm()), None, why, answerable=False))
    places: dict[str, Callable[[], Tensor]] = {
        f"cloth as band {i}": lambda i=i, colour=colour: scenery.drape(size, world.seed + i, colour)
        for i, colour in enumerate(bands, 1)
    }
    places["skin"] = lambda: scenery.skin(size, world.seed)
    places["clutter"] = lambda: scenery.clutter(size, world.seed, bands)
    places["heavy clutter"] = lambda: scenery.clutter(size, world.seed, bands, 4.0)
    places["texture"] = lambda: scenery.texture(size, world.seed)
    for i, image in enumerate(world.photographs):
        places[f"photograph {i}"] = lambda i=i, image=image: scenery.photograph(image, size, world.seed + i)
    for name, glove in (("white", scenery.WHITE_GLOVE), ("blue", scenery.BLUE_GLOVE)):
        places[f"{name} glove behind"] = lambda glove=glove: _hand_behind(world, pose, glove)
    cases += [world.case(name, pose, background, "all edges show") for name, background in places.items()]
    return cases


def occlusions(world: World, count: int = 1) -> list[Case]:
    """A finger over parts of the bands, at ``count`` poses: within a band, over one, over inner and outer edges.

    Answerable are those where two neighbouring bands show both their edges, whatever hides what is between.
    """
    rng, edges, cases = np.random.default_rng(world.seed), world.catheter.edges, []
    ends, last = (edges[0] - 0.015, edges[-1] + 0.015), len(edges) - 1
    spans = {}
    for i, (start, end) in enumerate(itertools.pairwise(edges), 1):
        long = end - start
        spans[f"within band {i}"] = (start + 0.3 * long, end - 0.3 * long)
        spans[f"over band {i}"] = (start - 0.1 * long, end + 0.1 * long)
    spans |= {f"over edge {i}": (edges[i] - 0.006, edges[i] + 0.006) for i in range(1, last)}
    for over in (0.002, 0.005, 0.010, 0.020):
        spans[f"over edge 0 by {1e3 * over:.0f} mm"] = (ends[0], edges[0] + over)
        spans[f"over edge {last} by {1e3 * over:.0f} mm"] = (edges[-1] - over, ends[1])
    spans["over all but band 1"] = (edges[1] - 0.003, ends[1])
    colours = itertools.cycle((scenery.SKIN, scenery.WHITE_GLOVE, scenery.BLUE_GLOVE))
    for turn, (name, hidden) in itertools.product(range(checks.whole("count", count, 1)), spans.items()):
        pose = world.pose(rng.uniform(0.42, 0.56), math.radians(rng.uniform(5, 30)), rng.uniform(0, 2 * math.pi))
        told, why = _told(edges, hidden)
        fingers = _finger(world, pose, hidden, next(colours))
        cases.append(world.case(f"{name}, {turn}", pose, None, why, answerable=told, occluders=fingers))
    return cases


def negatives(world: World, count: int) -> list[Case]:
    """``count`` frames without the catheter, of ten kinds in turn; none may be answered.

    Bare backgrounds, sheets of paper in the bands' colours (some in a row, in their order), photographs (the world's,
    or textures), clutter, hands, and sticks that differ from the catheter in one thing: the order of the colours (never
    merely turned round, which no camera could tell), the colours, the length of a band, or the thickness.
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
            wide = rng.uniform(15, 35) * world.size[1] / 1920
            changes["occluders"] = scenery.hand(at, rng.uniform(0, 2 * math.pi), wide, colour)
        cases.append(
            world.case(
                f"negative {i}, {kind}",
                pose,
                _somewhere(world, kind, i, rng),
                f"no catheter: {kind}",
                answerable=False,
                shown=stick,
                **changes,
            )
        )
    return cases


def _image_direction(world: World, pose: tuple[Tensor, Tensor]) -> np.ndarray:
    """Unit vector [2] of the axis in the frame, at the middle of the bands."""
    tip, direction = pose
    edges = world.catheter.edges
    middle = (edges[0] + edges[-1]) / 2
    start, end = world.camera.project(tip + torch.tensor([[middle - 1e-3], [middle + 1e-3]]) * direction).numpy()
    return (end - start) / np.linalg.norm(end - start)


def _half_out(world: World) -> list[Case]:
    """The right border of the frame cuts through a band."""
    edges, cases = world.catheter.edges, []
    border = torch.tensor([world.size[1] - 1.0, world.size[0] / 2], dtype=torch.float64)
    ray = torch.cat([world.camera.undistort(border), torch.ones(1, dtype=torch.float64)])
    last = len(edges) - 1
    for band, roll in ((last, 25), (last - 1, 25), (1, 205), (2, 205)):
        direction = aimed(_TILT, math.radians(roll))
        cut = (edges[band - 1] + edges[band]) / 2
        hidden = (cut, math.inf) if roll == 25 else (-math.inf, cut)
        told, why = _told(edges, hidden)
        side = "rear" if roll == 25 else "tip"
        pose = (_DEPTH * ray - cut * direction, direction)
        cases.append(world.case(f"{side} out of frame from band {band}", pose, None, why, answerable=told))
    return cases


def _hand_behind(world: World, pose: tuple[Tensor, Tensor], colour: scenery.Colour) -> Tensor:
    tip, direction = pose
    middle = tip + (world.catheter.edges[1] + world.catheter.edges[2]) / 2 * direction
    x, y = world.camera.project(middle).tolist()
    wide = 24 * world.size[1] / 1920
    parts = scenery.hand((x - 2 * wide, y - 4 * wide), 1.3, wide, colour)
    look = Look(world.desk(), noise_dn=0.0, occluders=parts)
    return render(None, world.camera, None, None, world.size, look)


def _finger(
    world: World, pose: tuple[Tensor, Tensor], span: tuple[float, float], colour: scenery.Colour
) -> tuple[Occluder, ...]:
    """A finger across the tube that hides ``span``, in metres from the tip."""
    tip, direction = pose
    start, end = world.camera.project(tip + torch.tensor(span, dtype=torch.float64)[:, None] * direction).numpy()
    wide = float(np.linalg.norm(end - start))
    across = np.array([-(end - start)[1], (end - start)[0]]) / wide
    # The round end begins beyond the tube, so that the sides are straight where they cross it.
    first = (start + end) / 2 - (wide / 8 + 8) * across
    last = first + 1200 * across
    return scenery.finger((float(first[0]), float(first[1])), (float(last[0]), float(last[1])), wide / 2, colour)


def _told(edges: Sequence[float], hidden: tuple[float, float]) -> tuple[bool, str]:
    """Whether two neighbouring bands show both their edges, with 2 mm to spare."""
    seen = [not hidden[0] - 0.002 <= edge <= hidden[1] + 0.002 for edge in edges]
    for i, three in enumerate(zip(seen, seen[1:], seen[2:], strict=False), 1):
        if all(three):
            return True, "all edges show" if all(seen) else f"bands {i} and {i + 1} show all their edges"
    return False, f"{sum(seen)} of {len(seen)} edges show, but no three in a row"


def _stick(catheter: Catheter, kind: str, rng: np.random.Generator) -> Catheter | None:
    """What may be taken for the catheter but is not; None where the kind shows no stick."""
    edges, colours = np.array(catheter.edges), catheter.colours
    if kind == "wrong order":
        orders = [order for order in itertools.permutations(colours) if order not in (colours, colours[::-1])]
        orders = [order for order in orders if all(math.dist(*pair) > 40 for pair in itertools.pairwise(order))]
        return replace(catheter, colours=orders[int(rng.integers(len(orders)))]) if orders else None
    if kind == "other colours":
        return replace(
            catheter, colours=max((_turned(colours, turn) for turn in (1 / 6, 1 / 2, 5 / 6)), key=_far(colours))
        )
    if kind == "unequal bands":
        # An inner band: a longer outer one is nearly what a slant does to equal ones.
        band = int(rng.integers(1, len(colours) - 1))
        edges[band + 1 :] += (edges[band + 1] - edges[band]) * (0.7 if rng.random() < 0.5 else -0.5)
        return replace(catheter, edges=tuple(edges.tolist()), length=max(catheter.length, float(edges[-1]) + 0.05))
    if kind == "thick":
        return replace(catheter, radius=min(rng.uniform(3, 5) * catheter.radius, 0.45 * float(np.diff(edges).min())))
    return None


def _turned(colours: Sequence[scenery.Colour], turn: float) -> tuple[scenery.Colour, ...]:
    """The same with another hue, ``turn`` of the circle further."""
    turned = []
    for colour in colours:
        hue, saturation, value = colorsys.rgb_to_hsv(*(level / 255 for level in colour))
        red, green, blue = (round(255 * level) for level in colorsys.hsv_to_rgb((hue + turn) % 1, saturation, value))
        turned.append((red, green, blue))
    return tuple(turned)


def _far(colours: Sequence[scenery.Colour]) -> Callable[[Sequence[scenery.Colour]], float]:
    return lambda others: min(math.dist(one, other) for one in colours for other in others)


def _somewhere(world: World, kind: str, i: int, rng: np.random.Generator) -> Callable[[], Tensor]:
    """A background for a negative."""
    size, bands, seed = world.size, world.catheter.colours, world.seed + 7919 * (i + 1)
    blue = ((60, 120, 180), (40, 70, 190), (60, 140, 110))[int(rng.integers(3))]
    photographs, which = world.photographs, int(rng.integers(max(len(world.photographs), 1)))
    if kind == "papers":
        return lambda: scenery.papers(size, seed, bands)
    if kind == "clutter":
        amount = float(rng.uniform(0.5, 4))
        return lambda: scenery.clutter(size, seed, bands, amount)
    if kind == "photograph" and photographs:
        return lambda: scenery.photograph(photographs[which], size, seed)
    if kind in ("photograph", "texture"):
        return lambda: scenery.texture(size, seed)
    place = (i // len(_KINDS) + int(rng.integers(2))) % 3
    if place == 0:
        return lambda: scenery.desk(size, seed)
    return (lambda: scenery.drape(size, seed, blue)) if place == 1 else (lambda: scenery.skin(size, seed))
