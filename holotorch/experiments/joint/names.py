"""Names of the compared methods and of the sets of views, for tables and pictures."""

NAMES = {
    "joint": "joint correction",
    "random": "ideal complex fields, random phases averaged",
    "afterwards": "random phases, corrected afterwards",
    "unheated": "views optimised without heat, corrected afterwards",
    "light_field": "one random view a step without heat, corrected afterwards",
    "retrieved": "Gerchberg-Saxton over all planes, heat ignored",
    "retrieved_pec": "Gerchberg-Saxton over all planes with deconvolution (thesis Algorithm 1)",
    "slabs": "one plane a frame (thesis Fig. 4.18)",
}
SETS = {
    "stack": "at the corrected foci",
    "held": "at foci between them",
    "half": "through half pupils",
    "part": "through circles",
}
