"""Light sources: spectra, coherence, and the wavelengths that are propagated through the optics."""
