"""Views of the joint correction: parts of the pupil, and steps that take some of the views."""
