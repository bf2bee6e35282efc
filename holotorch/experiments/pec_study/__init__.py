"""Comparisons of methods of proximity effect correction over several photographs."""
