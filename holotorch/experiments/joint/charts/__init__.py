"""Charts of joint correction: its methods beside each other, and the whole chain to the retina."""
