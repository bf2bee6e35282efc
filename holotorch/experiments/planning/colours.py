"""What each wavelength of a run shows of the colours of its picture or volume, in words."""

from collections.abc import Sequence


def colours_in_words(source: str, wavelengths: Sequence[float]) -> list[str]:
    """Line of a plan that says which colours of the ``source`` each wavelength shows; none for three wavelengths."""
    if len(wavelengths) == 3:
        return []
    names = [f"{wavelength * 1e9:.0f} nm" for wavelength in sorted(wavelengths, reverse=True)]
    if len(names) > 3:
        shown = (
            f"{len(names)} wavelengths share the {source}'s colours: 630 nm and longer ones show its red, 530 nm its"
        )
        rest = "green, 450 nm and shorter ones its blue, those between a mixture; pictures are mixed of all"
        return [f"Colours    {shown} {rest}"]
    if len(names) == 1:
        return [f"Colours    {names[0]} shows the mean of the {source}'s red, green and blue; pictures of it are grey"]
    shown = f"{names[0]} shows the mean of the {source}'s red and green, {names[1]} that of green and blue"
    return [f"Colours    {shown}; pictures show both in their own colours"]
