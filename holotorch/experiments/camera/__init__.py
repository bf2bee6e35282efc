"""Camera in the loop: a model of a chip is calibrated from images of random patterns, and then used for correction."""
