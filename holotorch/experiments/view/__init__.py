"""A live look at a finished run: a local page on which a user chooses depth, focus, pupil, light or heat."""
