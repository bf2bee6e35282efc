"""Measured error of the few wavelengths that represent the spectrum of a source."""

from holotorch.experiments.eye.experiment import PRESETS, RETINA, WAVELENGTHS, Observer
from holotorch.experiments.eye.plan import FLOP_SECONDS
from holotorch.experiments.planning.errors import LIMIT, Comparison, not_measured
from holotorch.experiments.planning.machine import Machine, machine_speed
from holotorch.experiments.volume.evaluation import pooled
from holotorch.experiments.volume.measured import hologram_error, relative_error
from holotorch.experiments.volume.plan import hologram_seconds
from holotorch.optics.light.spectral import spectral_image

_STEP = 1e-9  # metres between the wavelengths of the reference


def observer_errors(eye: Observer) -> list[Comparison]:
    """Predicted and measured errors of the parts that share the tolerance of a run.

    The error of the propagation to the retina is not measured, since its prediction excludes shifts of the picture.
    """
    note = "not measured: the prediction excludes shifts of the picture; for points of light see holotorch chart eye"
    retina = Comparison(RETINA, eye.budget.error(RETINA), None, note)
    return [hologram_error(eye.scene), wavelength_error(eye), retina]


def wavelength_error(eye: Observer) -> Comparison:
    """Error of the picture of the widest source, for the middle colour and focus and the first realisation.

    In the reference each wavelength in steps of 1 nm is propagated, by the method of the plan.
    """
    colour = len(eye.scene.settings.wavelengths) // 2
    depth, wavelength = eye.focus[len(eye.focus) // 2], eye.scene.settings.wavelengths[colour]
    every = {source: PRESETS[source](wavelength).every(_STEP) for source in eye.settings.light.sources}
    source = max(every, key=lambda name: len(every[name][0]))
    lengths, weights = every[source]
    predicted, plan = eye.budget.share(WAVELENGTHS), eye.retina(depth)
    if eye.separate:
        return Comparison(WAVELENGTHS, predicted, None, "not measured: every wavelength is propagated")

    def seconds(machine: Machine) -> float:
        pictures = plan.flops * FLOP_SECONDS[plan.method] * len(lengths)
        return hologram_seconds(eye.scene, machine) + pictures * machine.fft(plan.memory_bytes / 8)

    if seconds(Machine()) > LIMIT:
        return not_measured(WAVELENGTHS, predicted, seconds(machine_speed(eye.scene.device)))
    few = eye.samples(source, wavelength, depth)
    light = eye.scene.hologram(eye.settings.seed)[0][colour].conj()
    setup, elements = (eye.display, eye.eye(depth)), plan.method == "elements"
    images = [
        spectral_image(light, eye.scene.grid, *spectrum, *setup, count=count, elements=elements)
        for spectrum, count in ((few[:2], few[2]), ((lengths, weights), len(lengths)))
    ]
    error = relative_error(*(pooled(image, eye.scene.stride) for image in images))
    name = source.replace("_", " ")
    note = f"{few[2]} propagated of {len(few[0])} for the {name} at {wavelength * 1e9:.0f} nm, against all"
    return Comparison(WAVELENGTHS, predicted, error, f"{note} {len(lengths)} in steps of 1 nm")
