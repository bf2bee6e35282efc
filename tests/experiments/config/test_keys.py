"""Every key of every kind is explained, and nothing is explained that is no key."""

import re
from typing import Annotated

import pytest
from pydantic import BaseModel, Field

from holotorch.cli import main
from holotorch.experiments.config import keys as module
from holotorch.experiments.config.keys import keys
from holotorch.experiments.config.meanings import MEANINGS
from holotorch.experiments.registry import KINDS, find_kind


@pytest.mark.parametrize("kind", KINDS)
def test_every_key_has_a_meaning_values_and_a_default(kind):
    every = list(keys(find_kind(kind).settings))
    assert len(every) > 3
    assert not [key.name for key in every if not key.meaning or not key.values]
    assert not [key.name for key in every if not key.default and "section" not in key.values]
    assert len({(key.name, key.default, key.meaning) for key in every}) == len(every)


def test_no_meaning_is_left_over(monkeypatch):
    class Used(dict):
        asked: set[str] = set()

        def get(self, key, default=None):
            self.asked |= {key} if key in self else set()
            return super().get(key, default)

    monkeypatch.setattr(module, "MEANINGS", used := Used(MEANINGS))
    for kind in KINDS:
        list(keys(find_kind(kind).settings))
    assert used.asked == set(MEANINGS)


def test_values_defaults_and_kinds_of_section_are_in_words(capsys):
    found = {key.name: key for key in keys(find_kind("pec").settings)}
    assert found["wavelengths"].values == "list of length" and found["wavelengths"].default == "required"
    assert found["frames"].values == "whole number >= 1 and <= 64" and found["frames"].default == "1"
    assert found["target.fit"].values == "crop | pad"
    assert found["solver.kind"].values == "apg | adam | lbfgs"
    assert found["solver.memory"].meaning.startswith("(lbfgs) ")
    assert not found["solver.patience"].meaning.startswith("(")
    display = {key.name: key for key in keys(find_kind("eye").settings)}
    assert display["display.focus_distance"].default == "120 mm"
    assert display["eye.position"].values == "[length, length]"
    layout = {key.name: key for key in keys(find_kind("perception_layout").settings)}
    assert layout["items"].values == "list of sections" and "items.azimuth_deg" in layout
    assert main(["keys", "pec", "modulator"]) == 0
    out = capsys.readouterr().out
    assert "modulator.max_phase: phase >= 0.1 and <= 1000 or null [null]" in out
    assert "exp(-d^2/sigma^2)" in out and "solver" not in out


def test_of_several_bounds_the_tightest_are_said():
    class Odd(BaseModel):
        a: Annotated[int, Field(ge=1), Field(ge=4), Field(le=9), Field(lt=9)]
        b: Annotated[float, Field(gt=2), Field(ge=2), Field(ge=-1)]
        c: tuple[Annotated[int, Field(ge=1), Field(gt=0)], ...]

    values = {key.name: key.values for key in keys(Odd)}
    assert values == {
        "a": "whole number >= 4 and < 9",
        "b": "number > 2",
        "c": "list of whole number >= 1",
    }
    for kind in KINDS:
        for key in keys(find_kind(kind).settings):
            for each in re.split(r" or | \| |, ", key.values):
                assert each.count(">") <= 1 and each.count("<") <= 1, key


@pytest.mark.parametrize(("words", "said"), [(["pek"], "no kind 'pek'"), (["pec", "solvr"], "did you mean 'solver'")])
def test_what_is_no_kind_or_key_is_said(words, said, capsys):
    assert main(["keys", *words]) == 2
    assert said in capsys.readouterr().err
