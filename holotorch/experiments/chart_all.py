"""All charts one after another, on one page."""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from holotorch.experiments.chart import CHARTS, chart, description
from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.runs import page
from holotorch.io.files import write_text

PAGE = "index.html"
_WAITING, _INTERRUPTED = "not drawn yet", "interrupted"


@dataclass(frozen=True)
class Outcome:
    """Result of a subject: the lines of its verdict, or else the error that ended it."""

    seconds: float = 0.0
    verdict: Sequence[str] = ()
    problem: str = _WAITING


def chart_all(out: Path, *, quick: bool = False) -> dict[str, Outcome]:
    """Draw every chart into a folder of its own in ``out``, and the page ``index.html`` in ``out`` of all of them.

    A subject that fails is named on the page with its reason. The page is written again after every subject, so that
    an interruption keeps what is drawn; the remaining subjects are reported as not drawn yet.
    """
    out.mkdir(parents=True, exist_ok=True)
    outcomes = dict.fromkeys(CHARTS, Outcome())
    with tqdm(CHARTS, desc="charts", unit="subject", dynamic_ncols=True) as bar:
        for subject in bar:
            bar.set_postfix_str(subject)
            outcomes[subject] = _outcome(subject, out / subject, quick)
            if outcomes[subject].problem:
                tqdm.write(f"{subject}: {outcomes[subject].problem}", sys.stderr)
            write_text(out / PAGE, _page(outcomes, out, quick))
            if outcomes[subject].problem == _INTERRUPTED:
                break
    return outcomes


def interrupted(outcomes: dict[str, Outcome]) -> bool:
    """Whether the charts ended before the last subject."""
    return any(outcome.problem == _INTERRUPTED for outcome in outcomes.values())


def _outcome(subject: str, folder: Path, quick: bool) -> Outcome:
    start = time.perf_counter()
    try:
        return Outcome(verdict=chart(subject, folder, quick=quick), problem="", seconds=time.perf_counter() - start)
    except KeyboardInterrupt:
        problem = _INTERRUPTED
    except ConfigError as error:
        problem = str(error)
    except Exception as error:  # an error in one subject does not stop the others
        problem = f"{type(error).__name__}: {error}"
    return Outcome(time.perf_counter() - start, problem=problem)


def _page(outcomes: dict[str, Outcome], out: Path, quick: bool) -> str:
    drawn = sum(not outcome.problem for outcome in outcomes.values())
    title = "Speed against accuracy" + (", quick form" if quick else "")
    status = "complete" if drawn == len(outcomes) else f"{drawn} of {len(outcomes)} drawn"
    rows = [[name, f"{run.seconds:.1f}" if run.seconds else "", run.problem] for name, run in outcomes.items()]
    rows.append(["all", f"{sum(outcome.seconds for outcome in outcomes.values()):.1f}", ""])
    parts = [page.heading(title, status), page.table(("subject", "seconds", "problem"), rows)]
    for subject, outcome in outcomes.items():
        parts.append(page.element("h2", subject))
        parts += [page.element("p", outcome.problem, "warn")] if outcome.problem else _section(subject, outcome, out)
    return page.page(title, "\n".join(parts))


def _section(subject: str, outcome: Outcome, out: Path) -> list[str]:
    """Headline, picture, the rest of the verdict and the files of a subject that was drawn."""
    first, *rest = outcome.verdict
    files = sorted((out / subject).iterdir(), key=lambda path: (path.suffix != ".csv", path.name))
    links = {path.name: f"{subject}/{path.name}" for path in files if path.suffix in (".csv", ".png", ".txt")}
    return [
        page.element("p", first, "headline"),
        page.figure(f"{subject}/chart.png", description(subject), "wide"),
        *([page.fold("All of the verdict", rest)] if rest else []),
        page.addresses(links),
    ]
