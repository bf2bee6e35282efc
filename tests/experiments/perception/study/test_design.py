import json
from collections import Counter

import pytest

from holotorch.experiments.perception.study.design import THESIS_CONDITIONS, Design, make_design, round_orders, williams


def test_the_thesis_has_nine_eccentricities_and_52_conditions():
    assert len(THESIS_CONDITIONS) == 4 * 3 + 5 * 8 == 52
    assert sorted({e for e, _ in THESIS_CONDITIONS}) == [0, 10, 20, 30, 40, 50, 60, 70, 80]
    assert {s for e, s in THESIS_CONDITIONS if e == 30} == {5, 10, 15}
    assert {s for e, s in THESIS_CONDITIONS if e == 40} == {5, 8, 11, 14, 17, 20, 23, 26}


@pytest.mark.parametrize("order", ["thesis", "williams"])
@pytest.mark.parametrize("participant", [1, 2, 3])
def test_every_condition_comes_five_and_two_times_for_each_pattern(order, participant):
    design = make_design(participant, order=order, seed=3)
    trials = [t for t in design.trials if not t.practice]
    assert len(trials) == 52 * 14
    count = Counter((t.eccentricity_deg, t.size_deg, t.pattern, t.target) for t in trials)
    wanted = {True: 5, False: 2}
    assert count == {(*c, p, t): wanted[t] for c in THESIS_CONDITIONS for p in ("cross", "circle") for t in wanted}
    assert Counter(t.round for t in trials) == {1: 182, 2: 182, 3: 182, 4: 182}
    # One target per round, two rounds for each.
    goals = [{t.goal for t in trials if t.round == r} for r in (1, 2, 3, 4)]
    assert sorted(goal for (goal,) in goals) == ["circle", "circle", "cross", "cross"]
    sides = Counter((t.eccentricity_deg, t.size_deg, t.pattern, t.target, t.side) for t in trials)
    assert {sides[(*c, "cross", False, side)] for c in THESIS_CONDITIONS for side in ("left", "right")} == {1}
    assert {sides[(*c, "cross", True, side)] for c in THESIS_CONDITIONS for side in ("left", "right")} == {2, 3}
    assert all(0.8 <= t.wait_s <= 1.6 for t in trials)
    assert [t.trial for t in trials if t.round == 3] == list(range(1, 183))


def test_the_order_of_the_thesis_alternates_and_its_rounds_are_the_same_for_everybody():
    def rounds(participant: int) -> list[tuple]:
        trials = make_design(participant, seed=8).trials
        return [tuple((t.goal, t.eccentricity_deg, t.size_deg, t.pattern, t.side, t.wait_s) for t in trials
                      if t.round == r) for r in (1, 2, 3, 4)]  # fmt: skip

    odd, even = rounds(1), rounds(2)
    assert [r[0][0] for r in odd] == ["cross", "circle", "cross", "circle"]
    assert even == [odd[1], odd[0], odd[3], odd[2]]
    assert rounds(39) == odd and rounds(40) == even


def test_williams_participants_are_shuffled_anew_and_balanced_over_four():
    firsts = [make_design(p, order="williams", seed=1).trials for p in (1, 2, 3, 4, 5)]
    goals = ["".join(next(t.goal[1] for t in trials if t.round == r) for r in (1, 2, 3, 4)) for trials in firsts]
    # Rounds cross 1, circle 1, cross 2, circle 2 are 0 to 3; their orders 0132, 1203, 2310, 3021.
    assert goals[:4] == ["riir", "irri", "riir", "irri"] and goals[4] == goals[0]
    assert [t.wait_s for t in firsts[0]] != [t.wait_s for t in firsts[4]]


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 6, 7])
def test_williams_squares_balance_places_and_neighbours(n):
    rows = williams(n)
    assert len(rows) == (n if n % 2 == 0 or n == 1 else 2 * n)
    share = len(rows) // n
    for place in range(n):
        assert Counter(row[place] for row in rows) == dict.fromkeys(range(n), share)
    pairs = Counter(pair for row in rows for pair in zip(row, row[1:], strict=False))
    assert pairs == {(a, b): share for a in range(n) for b in range(n) if a != b}


def test_the_thesis_order_is_that_of_the_page():
    # "cross1, circle1, cross2 circle2" and "circle1, cross1, circle2, cross2"
    assert round_orders("thesis") == ((0, 1, 2, 3), (1, 0, 3, 2))


def test_practice_comes_first_with_the_target_of_the_first_round():
    for participant in (1, 2):
        design = make_design(participant, practice=9)
        assert [t.round for t in design.trials[:10]] == [0] * 9 + [1]
        assert {t.goal for t in design.trials[:10]} == {("cross", "circle")[participant - 1]}
    assert not any(t.practice for t in make_design(1, practice=0).trials)


def test_seeds_and_json():
    one, again, other = make_design(3, seed=1), make_design(3, seed=1), make_design(3, seed=2)
    assert one == again and one.name == again.name and one.name != other.name
    assert make_design(3, sides="left", seed=1).name != one.name
    data = json.loads(json.dumps(one.to_json()))
    assert Design.from_json(data) == one
    data["trials"][5]["size_deg"] += 1
    with pytest.raises(ValueError, match="changed"):
        Design.from_json(data)
    for wrong in ({}, [], {**one.to_json(), "trials": [{"round": 1}]}):
        with pytest.raises(ValueError, match="design"):
            Design.from_json(wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"participant": 0}, "participant: expected a number from 1, got 0"),
        ({"participant": True}, "participant: expected"),
        ({"conditions": []}, "at least one pair"),
        ({"conditions": [(10, 5), (10, 5)]}, "10 deg with size 5 deg is there twice"),
        ({"conditions": [(-10, 5)]}, "got -10 deg"),
        ({"conditions": [(float("nan"), 5)]}, "got nan deg"),
        ({"conditions": [(10, 0)]}, "size 0 deg"),
        ({"target_repeats": 0}, "target: expected a whole number from 1, got 0"),
        ({"distraction_repeats": -1}, "distraction: expected a whole number from 0"),
        ({"order": "random"}, "order: expected one of thesis, williams, got 'random'"),
        ({"sides": "up"}, "sides: expected left, right or both"),
        ({"wait_s": (2.0, 1.0)}, "wait_s"),
        ({"target_repeats": 5 * 10**12}, "at most 10000 trials for a participant, got 520000000000208"),
        ({"wait_s": (800, 1600)}, "between 0 and 60 s"),
    ],
)
def test_impossible_designs_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        make_design(**{"participant": 1, **change})
