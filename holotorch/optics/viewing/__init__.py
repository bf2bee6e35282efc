"""A display and the eye that looks through it, to the retina."""
