"""Notes of a plan about what no solver can mend."""

import pytest
from paths import CONFIGS

from holotorch.experiments.pec.plan import plan_values
from holotorch.experiments.pec.report import pec_outcome
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


@pytest.mark.parametrize(
    ("sigma", "limit", "noted"), [(0.66, 4, True), (0.66, 6, False), (1.5, 10, True), (1.5, 12, False)]
)
def test_a_limit_that_loses_a_picture_in_the_far_field_is_noted(sigma, limit, noted):
    """Below 4 rad times the root of the kernel's sum: 4.8 rad at 0.66 px, 10.6 rad at 1.5 px."""
    words = [f"modulator={{sigma_px: {sigma}, max_phase: {limit}}}", "solver={kind: lbfgs}", "grid.shape=[32,32]"]
    for config, far in (("fourier", True), ("fresnel", False)):
        notes = plan_values(find_kind("pec").build(load_config(CONFIGS / "pec" / f"{config}.yaml", words)))["notes"]
        assert any("in the far field this kernel needs" in note for note in notes) == (noted and far)


def test_the_phase_per_kelvin_may_be_given_at_any_wavelength():
    limits = []
    for words in ("rad_per_K: 0.02", "rad_per_K: 0.02, rad_per_K_at: 630 nm", "rad_per_K: 0.024, rad_per_K_at: 525 nm"):
        chip = f"modulator={{sigma_px: 0.66, max_temperature: 300 degC, {words}}}"
        given = [chip, "solver={kind: lbfgs}", "grid.shape=[32,32]", "wavelengths=[525 nm]"]
        experiment = find_kind("pec").build(load_config(CONFIGS / "pec" / "fourier.yaml", given))
        limits.append(experiment.limit)
        assert experiment.array.response == pytest.approx([0.024])
    assert limits == pytest.approx([7.2] * 3)


def test_a_poor_picture_at_its_limit_says_so():
    def outcome(**corrected) -> str:
        numbers = {"peak_temperature_rise_K": [300.0], "frames": 4} | corrected
        return "\n".join(pec_outcome({"methods": {"corrected": numbers}}))

    assert "at their limit" in outcome(ssim_mean=0.4, at_limit=True)
    assert "limit" not in outcome(ssim_mean=0.4, at_limit=False) + outcome(ssim_mean=0.95, at_limit=True)
    assert "silicon has melted" in outcome(peak_temperature_rise_K=[300.0, 1500.0])
