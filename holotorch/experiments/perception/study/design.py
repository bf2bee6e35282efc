"""Design of a study of perception time: the patterns, sizes, eccentricities, sides and order of all trials.

As in thesis Sec. 2.3, crosses and circles appear at nine eccentricities. Each pair of eccentricity and size is shown
five times per pattern as the target and twice per pattern as the distraction. There are four rounds; the cross is the
target in two of them.
"""

import hashlib
import json
import random
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any, Literal

Pattern = Literal["cross", "circle"]
Side = Literal["left", "right"]
_Appearance = tuple[float, float, Side, Pattern, bool, float, float]  # from eccentricity_deg on, except wait_s
_OTHER: dict[Pattern, Pattern] = {"cross": "circle", "circle": "cross"}
_SIDES: dict[str, tuple[Side, ...]] = {"left": ("left",), "right": ("right",), "both": ("left", "right")}
ORDERS = ("thesis", "williams")
# (eccentricity, size) in degrees: three sizes at the inner four eccentricities, eight at the outer five.
THESIS_CONDITIONS = tuple((float(e), float(s)) for e in (0, 10, 20, 30) for s in (5, 10, 15)) + tuple(
    (float(e), float(s)) for e in (40, 50, 60, 70, 80) for s in (5, 8, 11, 14, 17, 20, 23, 26)
)
AS_IN_THESIS = (1.0, 0.0)  # contrast and speed in deg/s of the patterns of the thesis: black and at rest
MOST_TRIALS = 10_000  # largest number of trials per participant; they take seven hours at 2.5 s per trial
# Target of each round, and which half of the trials with this target the round has.
_ROUNDS: tuple[tuple[Pattern, int], ...] = (("cross", 1), ("circle", 1), ("cross", 2), ("circle", 2))


@dataclass(frozen=True)
class Trial:
    """One appearance of a pattern."""

    round: int  # 1 to 4; 0 is the practice round
    trial: int  # 1, 2, ... within the round
    eccentricity_deg: float  # angle between the fixation point and the centre of the pattern, >= 0
    size_deg: float  # angle that the pattern subtends
    side: Side  # side of the fixation point
    pattern: Pattern
    target: bool  # whether the pattern is the target of the round, which should be answered
    wait_s: float  # time from the end of the previous trial to the appearance of the pattern
    contrast: float = AS_IN_THESIS[0]  # Weber contrast of the dark pattern, 1 for black
    speed_deg_s: float = AS_IN_THESIS[1]  # speed of the pattern, which moves up and down

    def to_json(self) -> dict[str, Any]:
        """The trial as JSON data; contrast and speed only if they differ from those of the thesis."""
        data = asdict(self)
        if (self.contrast, self.speed_deg_s) == AS_IN_THESIS:
            del data["contrast"], data["speed_deg_s"]
        return data

    @property
    def practice(self) -> bool:
        """Whether the trial belongs to the practice round."""
        return self.round == 0

    @property
    def goal(self) -> Pattern:
        """The target pattern of this round."""
        return self.pattern if self.target else _OTHER[self.pattern]


@dataclass(frozen=True)
class Design:
    """All trials of one participant, in order."""

    participant: int
    trials: tuple[Trial, ...]

    @property
    def name(self) -> str:
        """A short hash of all trials, which differs if any trial differs."""
        text = json.dumps([trial.to_json() for trial in self.trials], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def to_json(self) -> dict[str, Any]:
        """The design as JSON data, which ``from_json`` reads."""
        return {
            "format": "holotorch-design",
            "version": 1,
            "participant": self.participant,
            "name": self.name,
            "trials": [trial.to_json() for trial in self.trials],
        }

    @staticmethod
    def from_json(data: dict[str, Any]) -> "Design":
        """Read the data of ``to_json``. ValueError for other data, and if a trial was changed."""
        if not isinstance(data, dict) or data.get("format") != "holotorch-design" or data.get("version") != 1:
            raise ValueError("expected a design of format holotorch-design, version 1")
        try:
            design = Design(data["participant"], tuple(Trial(**trial) for trial in data["trials"]))
        except (KeyError, TypeError) as error:
            raise ValueError(f"a design that cannot be read: {error}") from None
        if design.name != data.get("name"):
            raise ValueError(f"a design that was changed: it says {data.get('name')}, but its trials are {design.name}")
        return design


def williams(n: int) -> tuple[tuple[int, ...], ...]:
    """Orders of 0 ... n - 1 balanced for carry-over (Williams 1949).

    Every item occurs equally often at every position, and directly after every other item. There are n orders for even
    n, and 2 n for odd n.
    """
    if n < 1:
        raise ValueError(f"expected at least one item to order, got {n}")
    first = [(k + 1) // 2 if k % 2 else (n - k // 2) % n for k in range(n)]  # 0, 1, n - 1, 2, n - 2, ...
    rows = [tuple((item + shift) % n for item in first) for shift in range(n)]
    return tuple(rows + [row[::-1] for row in rows] if n % 2 and n > 1 else rows)


def round_orders(order: str) -> tuple[tuple[int, ...], ...]:
    """Orders of the rounds cross 1, circle 1, cross 2, circle 2, which are assigned to participants in turn."""
    if order not in ORDERS:
        raise ValueError(f"order: expected one of {', '.join(ORDERS)}, got {order!r}")
    return ((0, 1, 2, 3), (1, 0, 3, 2)) if order == "thesis" else williams(4)


def make_design(
    participant: int,
    conditions: Sequence[tuple[float, float]] = THESIS_CONDITIONS,
    *,
    target_repeats: int = 5,
    distraction_repeats: int = 2,
    order: str = "thesis",
    sides: str = "both",
    practice: int = 14,
    wait_s: tuple[float, float] = (0.8, 1.6),
    variants: Sequence[tuple[float, float]] = (AS_IN_THESIS,),
    seed: int = 0,
) -> Design:
    """Draw the trials of one participant; equal arguments give equal trials.

    Args:
        participant: Number of the participant, 1, 2, ..., which determines the order of the rounds.
        conditions: Pairs (eccentricity, size) in degrees.
        target_repeats: Trials per condition and pattern as the target.
        distraction_repeats: Trials per condition and pattern as the distraction.
        order: "thesis": all participants have the same four rounds; odd numbers have the targets cross, circle, cross,
            circle, even numbers circle, cross, circle, cross. "williams": the four orders of a Williams square are
            assigned in turn, and the trials are shuffled for each participant.
        sides: "left", "right" or "both". With "both", the numbers of trials on the two sides differ by at most one in
            each condition, role and pattern. The thesis does not state the sides.
        practice: Number of practice trials, which have the target of the first round; limited to the number of trials
            in the two rounds with this target.
        wait_s: Bounds of the uniformly distributed time before each appearance.
        variants: Pairs (contrast, speed in deg/s) with which every condition is shown.
        seed: Seed of the random numbers.

    Raises:
        ValueError: The participant is below 1, there are no conditions or duplicates, an angle, count or time is out
            of range, or there are more than ``MOST_TRIALS`` trials.
    """
    if isinstance(participant, bool) or participant < 1:
        raise ValueError(f"participant: expected a number from 1, got {participant}")
    _check(conditions, target_repeats, distraction_repeats, practice, wait_s, variants)
    if sides not in _SIDES:
        raise ValueError(f"sides: expected left, right or both, got {sides!r}")
    orders = round_orders(order)
    rng = random.Random(f"holotorch {seed}" + (f" {participant}" if order == "williams" else ""))
    blocks: dict[tuple[Pattern, int], list[_Appearance]] = {}
    for goal in ("cross", "circle"):
        drawn = _shuffled(rng, conditions, variants, goal, target_repeats, distraction_repeats, sides)
        half = (len(drawn) + 1) // 2
        blocks[goal, 1], blocks[goal, 2] = drawn[:half], drawn[half:]
    waits = {name: [round(rng.uniform(*wait_s), 4) for _ in block] for name, block in blocks.items()}
    rounds = [_ROUNDS[i] for i in orders[(participant - 1) % len(orders)]]
    rng = random.Random(f"holotorch practice {seed} {participant}")
    drawn = _shuffled(rng, conditions, variants, rounds[0][0], target_repeats, distraction_repeats, sides)
    trials = [_trial(0, i, item, round(rng.uniform(*wait_s), 4)) for i, item in enumerate(drawn[:practice], 1)]
    for number, name in enumerate(rounds, 1):
        timed = zip(blocks[name], waits[name], strict=True)
        trials += [_trial(number, i, item, wait) for i, (item, wait) in enumerate(timed, 1)]
    return Design(participant, tuple(trials))


def too_many(trials: int) -> str:
    """Error message for more than ``MOST_TRIALS`` trials."""
    return f"expected at most {MOST_TRIALS} trials for a participant, got {trials}; lower the repeats or conditions"


def _trial(number: int, index: int, item: _Appearance, wait_s: float) -> Trial:
    *first, contrast, speed = item
    return Trial(number, index, *first, wait_s, contrast, speed)  # type: ignore[arg-type]


def _shuffled(
    rng: random.Random, conditions, variants, goal: Pattern, targets: int, distractions: int, sides: str
) -> list[_Appearance]:
    """All trials with the target ``goal``, in random order."""
    roles: tuple[tuple[Pattern, int], ...] = ((goal, targets), (_OTHER[goal], distractions))
    appearances: list[_Appearance] = []
    for (eccentricity, size), (contrast, speed) in product(conditions, variants):
        for pattern, count in roles:
            start = rng.randrange(2)
            for i in range(start, start + count):
                side = _SIDES[sides][i % len(_SIDES[sides])]
                pair = float(eccentricity), float(size)
                appearances.append((*pair, side, pattern, pattern == goal, float(contrast), float(speed)))
    rng.shuffle(appearances)
    return appearances


def _check(conditions, targets: int, distractions: int, practice: int, wait_s: tuple[float, float], variants) -> None:
    if not conditions:
        raise ValueError("conditions: expected at least one pair of eccentricity and size, got none")
    if not variants or len(set(variants)) < len(variants):
        raise ValueError(f"variants: expected different pairs of contrast and speed, got {list(variants)}")
    if any(not (0 < contrast <= 1 and 0 <= speed < 1000) for contrast, speed in variants):
        raise ValueError(f"variants: expected contrasts in (0, 1] and speeds from 0 deg/s, got {list(variants)}")
    if (trials := 2 * len(conditions) * len(variants) * (targets + distractions)) > MOST_TRIALS:
        raise ValueError(too_many(trials))
    if len(set(conditions)) < len(conditions):
        twice = next(pair for pair in conditions if list(conditions).count(pair) > 1)
        raise ValueError(f"conditions: {twice[0]:g} deg with size {twice[1]:g} deg is there twice; raise the repeats")
    for eccentricity, size in conditions:
        if not (0 <= eccentricity < 180 and 0 < size < 90):
            raise ValueError(
                "conditions: expected eccentricities from 0 to below 180 deg and sizes between 0 and 90 deg, got "
                f"{eccentricity:g} deg with size {size:g} deg"
            )
    for name, count, least in (("target", targets, 1), ("distraction", distractions, 0), ("practice", practice, 0)):
        if isinstance(count, bool) or count < least:
            raise ValueError(f"{name}: expected a whole number from {least}, got {count}")
    if not 0 <= wait_s[0] <= wait_s[1] < 60:
        raise ValueError(f"wait_s: expected a least and a most wait between 0 and 60 s, got {list(wait_s)}")
