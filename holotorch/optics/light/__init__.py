"""Light sources: spectra, coherence, and what of them is followed through the optics."""
