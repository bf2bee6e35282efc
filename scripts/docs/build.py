"""Build guide, gallery and the pages of public names as HTML, without a network; every warning is an error.

``python scripts/docs/build.py`` runs the scripts of the gallery; ``--quick`` shows their committed pictures instead.
"""

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
SCRIPTS = FOLDER.parent
# Titles on the page of the gallery; the sentence below each is the docstring of the script.
TITLES = {
    "beam": "A beam and its waist",
    "camera_in_the_loop": "A camera in the loop",
    "cylinder": "Cylindrical lenses",
    "encodings": "Phase-only panels",
    "end_to_end": "From the retina back to the heaters",
    "every_focus": "Right at every focus",
    "four_f": "Filtering between two lenses",
    "frames": "Several frames",
    "heat": "Correcting the heat",
    "learn_distance": "Learning a distance",
    "retina": "What an eye sees",
    "shadows": "Light and shadow in a volume",
    "talbot": "The Talbot effect",
    "volume": "A hologram of a volume",
    "vortex": "An optical vortex",
}


def stage(source: Path, *, quick: bool) -> None:
    """Copy the pages and what they show to ``source``, so that nothing is written into the checkout.

    Scripts of the gallery draw their pictures, except with ``quick``, and get titles. Pages show them without the last
    lines, in which a script finds its own place: Sphinx, which runs what it shows, has none for them.
    """
    shutil.rmtree(source, ignore_errors=True)
    shutil.copytree(FOLDER, source / "docs", ignore=shutil.ignore_patterns("*.py", "static", "__pycache__"))
    for pictures in ("gallery", "charts"):
        for path in (SCRIPTS / pictures).rglob("*.png"):
            copy = source / path.relative_to(SCRIPTS)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, copy)
    shutil.copy(SCRIPTS / "gallery" / "GALLERY_HEADER.rst", source / "gallery")
    for script in sorted((SCRIPTS / "gallery").glob("*.py")):
        staged = Path(shutil.copy(script, source / "gallery"))
        if not quick:
            print(script.name, flush=True)
            subprocess.run([sys.executable, staged], check=True, cwd=SCRIPTS.parent)
        text, title = script.read_text(encoding="utf-8"), TITLES[script.stem]
        first, rest = text.partition("\n\n\nif __name__")[0].split("\n", 1)
        sentence = first.strip('"')
        heading = f"{title}\n{'=' * len(title)}\n\n{sentence} ``python scripts/gallery/{script.name}`` draws it."
        staged.write_text(f'"""\n{heading}\n"""\n{rest}\n', encoding="utf-8")


def main() -> int:
    """Build; the exit status is that of Sphinx, or 2 if it is not installed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--quick", action="store_true", help="show the committed pictures; run no script of the gallery"
    )
    parser.add_argument("--out", type=Path, default=SCRIPTS.parent / "runs" / "guide", help="folder (runs/guide)")
    chosen = parser.parse_args()
    try:
        from sphinx.cmd.build import build_main
    except ImportError:
        print("Sphinx is needed to build the guide: pip install 'holotorch[docs]'", file=sys.stderr)
        return 2
    out = chosen.out.resolve()
    stage(out / "source", quick=chosen.quick)
    html = out / "html"
    options = ["-q", "-W", "--keep-going", "-n", "-E", "-d", str(out / "doctrees"), "-c", str(FOLDER)]
    status = build_main([*options, str(out / "source" / "docs"), str(html)])
    if status == 0:
        print(html / "index.html")
    return status


if __name__ == "__main__":
    sys.exit(main())
