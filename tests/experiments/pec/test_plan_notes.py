"""Notes of a plan about what no solver can mend."""

import pytest
from paths import CONFIGS

from holotorch.experiments.pec.plan import plan_values
from holotorch.experiments.registry import find_kind, load_config


@pytest.mark.parametrize(("limit", "noted"), [("5 degC", True), ("500 degC", False)])
def test_a_limit_that_steers_no_light_is_noted(limit, noted):
    words = [f"modulator={{sigma_px: 0.66, max_temperature: {limit}}}", "solver={kind: lbfgs}", "grid.shape=[32,32]"]
    settings = load_config(CONFIGS / "pec" / "fourier.yaml", words)
    notes = plan_values(find_kind("pec").build(settings))["notes"]
    assert any("steers little light" in note for note in notes) == noted


@pytest.mark.parametrize(("distance", "noted"), [("10 mm", False), ("3 m", True)])
def test_a_distance_at_which_the_array_forms_no_picture_is_noted(distance, noted):
    words = ["grid.shape=[112,112]", "grid.pitch=7um", f"propagator.distance={distance}"]
    notes = plan_values(find_kind("pec").build(load_config(CONFIGS / "pec" / "fresnel.yaml", words)))["notes"]
    assert any("forms no picture there" in note for note in notes) == noted
