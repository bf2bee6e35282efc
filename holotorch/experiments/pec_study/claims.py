"""Statements of the thesis about proximity effect correction, compared with the numbers of a study."""

from collections.abc import Callable, Iterable
from typing import Any

Row = dict[str, Any]


def with_claims(study: str, rows: list[Row]) -> list[Row]:
    """``rows``, followed by one row for each statement: its text, the measured value, and whether they agree."""
    claims = _CLAIMS[study](rows) if study in _CLAIMS else ()
    return rows + [
        dict.fromkeys(rows[0], "") | {"setting": measured, "method": "claim", "thesis": claim, "verdict": verdict}
        for claim, measured, verdict in claims
    ]


Claims = Iterable[tuple[str, str, str]]


def _reproduction(rows: list[Row]) -> Claims:
    for name, words in (
        ("PPEC", "PPEC and FPEC keep their quality up to sigma 0.9 and dip slightly at 1.0 (Sec. 4.5.1.1)"),
        ("IPEC", "IFPEC degrades from sigma 0.4 on (Fig. 4.17)"),
        ("none", "without correction quality falls from sigma 0.3 on (Fig. 4.17)"),
    ):
        chosen = [row for row in rows if row["method"] == name and row["kind"] == "fresnel" and row["ssim"] != ""]
        weak, strong = (
            [row["ssim"] for row in chosen if low <= row["sigma_px"] <= high] for low, high in ((0, 0.5), (0.6, 1.0))
        )
        if weak and strong:
            drop = max(weak) - min(strong)
            agrees = drop < 0.1 if name == "PPEC" else drop > 0.1
            yield words, f"SSIM falls by {drop:.3f} between sigma <= 0.5 and 1.0", _verdict(agrees)


def _lowpass(rows: list[Row]) -> Claims:
    for name in ("basic IPEC", "IPEC", "PPEC"):
        values = [row["ssim"] for row in rows if row["method"] == name]
        change = max(values) - min(values)
        words = "no significant change with the picture's spatial frequency (Fig. 4.12)"
        yield f"{name}: {words}", f"SSIM {min(values):.3f} to {max(values):.3f}", _verdict(change < 0.05)


def _multiplexing(rows: list[Row]) -> Claims:
    ssim = {row["method"]: row["ssim"] for row in rows if row["sigma_px"] < 0.7}
    for name in ("IPEC, 10 runs", "IPEC, signal region"):
        if name in ssim and "PPEC" in ssim:
            behind = ssim["PPEC"] - ssim[name]
            words = f"{name}: comparable with PPEC below sigma 0.7 (Fig. 4.14)"
            yield words, f"SSIM {ssim[name]:.3f}, PPEC {ssim['PPEC']:.3f}", _verdict(behind < 0.1)


def _iterations(rows: list[Row]) -> Claims:
    ssim = [row["ssim"] for row in rows if row["sigma_px"] == 0.66 and row["method"] == "PPEC"]
    if ssim:
        gain = ssim[-1] - ssim[len(ssim) // 2]
        words = "PPEC, sigma 0.66: quality changes very little towards the end (Fig. 4.15)"
        yield words, f"SSIM gains {gain:.3f} in the second half of the steps", _verdict(abs(gain) < 0.02)


def _time(rows: list[Row]) -> Claims:
    def seconds(name: str, **wanted: Any) -> list[float]:
        return [r["seconds"] for r in rows if r["method"] == name and all(r[key] == wanted[key] for key in wanted)]

    middle = {"setting": rows[0]["setting"], "sigma_px": 0.66}
    basic, iterative, proximal = (min(seconds(name, **middle), default=0) for name in ("basic IPEC", "IPEC", "PPEC"))
    measured = f"basic {basic:.2f} s, IPEC {iterative:.2f} s, PPEC {proximal:.2f} s"
    yield "basic IPEC is the fastest (Fig. 4.10)", measured, _verdict(basic <= min(iterative, proximal))
    yield "IPEC is slower than PPEC (Fig. 4.10)", measured, _verdict(iterative >= proximal)
    for name in ("IPEC", "PPEC"):
        times = seconds(name, sigma_px=0.66)[-4:]
        words = f"{name}: time grows with resolution (Fig. 4.11)"
        yield words, ", ".join(f"{value:.2f}" for value in times) + " s", _verdict(times == sorted(times))


def _focus(rows: list[Row]) -> Claims:
    for name in dict.fromkeys(row["method"] for row in rows if row["error"] != ""):
        sharp = total = 0
        for sigma in dict.fromkeys(row["sigma_px"] for row in rows):
            chosen = [r for r in rows if r["method"] == name and r["sigma_px"] == sigma and r["error"] != ""]
            for band in dict.fromkeys(row["setting"].split(", ")[1] for row in chosen):
                errors = {r["setting"].split(", ")[0]: r["error"] for r in chosen if r["setting"].endswith(band)}
                sharp += band.split()[2] == min(errors, key=errors.__getitem__).split()[1]
                total += 1
        words = f"{name}: moving the focus brings one part of the scene after another into focus (Fig. 4.18)"
        yield words, f"{sharp} of {total} bands are sharpest at their own depth", _verdict(sharp == total)


_CLAIMS: dict[str, Callable[[list[Row]], Claims]] = {
    "reproduction": _reproduction,
    "lowpass": _lowpass,
    "multiplexing": _multiplexing,
    "iterations": _iterations,
    "time": _time,
    "focus": _focus,
}


def _verdict(agrees: bool) -> str:
    return "reproduced" if agrees else "not reproduced"
