"""Commands of ``python -m eval``: their arguments and what they run."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import NoReturn

from dvo.core.errors import DvoError
from dvo.core.text import print_line
from dvo.data.files.root import data_root
from eval.execution.plan import AXES, LOOPS, PAGE, RESULTS, TABLE, Plan, read_manifest
from eval.execution.runner import predict_all
from eval.reporting.report import write_report, write_tables
from eval.scoring.score import score_all
from eval.suites.selection import folder_of_data, is_rendered, load_suites, settle
from eval.suites.suite import read_suites, suite_names
from eval.systems.registry import DEFAULT, list_systems


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """One line, as for every other mistake."""
        raise DvoError(message, remedy=f"see {self.prog} --help")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    line = _Parser(prog="python -m eval", description="Every system on every sequence, one protocol, one report.")
    verbs = line.add_subparsers(dest="verb", required=True, parser_class=_Parser)
    run = verbs.add_parser("run", help="run systems on suites, score them, write tables and report")
    run.add_argument("--suite", default="validation", metavar="NAME[,NAME]",
                     help="names in configs/eval, YAML files, or folders of sequences (validation)")  # fmt: skip
    run.add_argument(
        "--systems", default=",".join(DEFAULT), help=f"names with commas between, see: list ({','.join(DEFAULT)})"
    )
    run.add_argument("--sequences", help="names with commas between (all of the suites)")
    run.add_argument("--seeds", type=int, default=1, metavar="N", help="seeds 0 to N-1 (1)")
    run.add_argument("--stride", type=int, metavar="N", help="feed every N-th image (as in the suite)")
    run.add_argument("--data", type=Path, metavar="DIR", help="folder of the recordings ($DVO_DATA, ../shared/data)")
    run.add_argument("--out", type=Path, default=Path("results/eval"), metavar="DIR", help="results (results/eval)")
    run.add_argument("--weights", metavar="FILE", help="weights for dvo-... systems in place of the package's own")
    run.add_argument("--device", default="cpu", help="where networks compute (cpu)")
    run.add_argument("--threads", type=int, default=2, metavar="N", help="threads of one run (2)")
    run.add_argument(
        "--workers", type=int, default=1, metavar="N", help="runs at a time; above 1, timings are marked (1)"
    )
    run.add_argument("--ray", metavar="ADDRESS", help="run on a Ray cluster: auto, ray://HOST:PORT, or local")
    run.add_argument("--retry", action="store_true", help="run again what failed before")
    run.add_argument("--no-report", action="store_true", help="tables only, no figures and no page")
    run.add_argument("--score-only", action="store_true", help="the same as: score DIR")
    run.add_argument("--list", action="store_true", help="the same as: list")
    for name, about in (("score", "score the predictions in a folder again: results.csv and tables"),
                        ("report", "score, then write report.html and its figures")):  # fmt: skip
        verb = verbs.add_parser(name, help=about)
        verb.add_argument("out", type=Path, metavar="DIR", help="folder of an evaluation")
    listing = verbs.add_parser("list", help="systems with licence and state; suites with their sequences")
    listing.add_argument("--data", type=Path, metavar="DIR", help="folder of the recordings")
    ahead = verbs.add_parser("prepare", help="render suites ahead of an evaluation")
    ahead.add_argument("suites", nargs="+", metavar="SUITE", help="axes, axes/test, fast/test/large, memory, world")
    ahead.add_argument("--sheet", type=Path, metavar="PNG", help="write a contact sheet too")
    words = verbs.add_parser("vocabulary", help="train a vocabulary for ORB-SLAM3 on rendered pictures")
    words.add_argument("--out", type=Path, required=True, metavar="FILE", help="text file that ORB-SLAM3 reads")
    for name, default, about in (
        ("sequences", 60, "rendered sequences"),
        ("frames", 5, "pictures of each"),
        ("features", 1000, "descriptors of each picture"),
        ("branching", 10, "children of a node"),
        ("depth", 4, "levels of the tree"),
        ("seed", 0, "of renderings and clusters"),
    ):
        words.add_argument(f"--{name}", type=int, default=default, metavar="N", help=f"{about} ({default})")
    return line


def run(given: argparse.Namespace) -> None:
    """``run``: predictions, scores, tables, and the report."""
    if given.score_only:
        return score(given)
    _need_evo()
    for name in ("seeds", "stride", "threads", "workers"):
        value = getattr(given, name)
        if value is not None and value < 1:
            raise DvoError(f"must be 1 or more, got {value}", field=f"--{name}", remedy="give a whole number")
    systems = names_in(given.systems)
    if not systems:
        raise DvoError("no system", field="--systems", remedy="give one, see: python -m eval list")
    suites = load_suites(names_in(given.suite), names_in(given.sequences or ""), given.stride)
    plan = Plan(
        suites=tuple(suites),
        systems=tuple(systems),
        seeds=tuple(range(given.seeds)),
        data=folder_of_data(suites, given.data),
        out=given.out,
        weights=given.weights,
        device=given.device,
        threads=given.threads,
        workers=given.workers,
        ray=given.ray,
        retry=given.retry,
    )
    try:
        plan.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DvoError(str(error.strerror), file=plan.out, field="--out", remedy="give another folder") from error
    predict_all(plan, say=progress)
    _finish(plan.out, page=not given.no_report)


def score(given: argparse.Namespace) -> None:
    """``score``: results.csv and the tables from the predictions in a folder."""
    _need_evo()
    _finish(given.out, page=False)


def report(given: argparse.Namespace) -> None:
    """``report``: scores, tables and the page from the predictions in a folder."""
    _need_evo()
    _finish(given.out, page=True)


def show_list(given: argparse.Namespace) -> None:
    """``list``: systems and suites, and what they lack."""
    print_line("Systems")
    for system in list_systems():
        print_line(f"  {system.name:14} {system.licence:10} {system.missing() or 'available'}")
        print_line(f"      {system.about}")
    try:
        data: Path | None = data_root(getattr(given, "data", None))
        print_line()
        print_line(f"Suites (data in {data})")
    except DvoError as error:
        data = None
        print_line()
        print_line(f"Suites ({error})")
    for name in suite_names():
        try:
            suites = load_suites([name])
        except DvoError as error:
            print_line(f"  {name}: {error}")
            continue
        for suite in suites:
            print_line(f"  {suite.name:14} {suite.label}")
            for sequence in suite.sequences:
                print_line(f"      {sequence.name:28} {_state(suite, sequence, data)}")
            if suite.download:
                print_line(f"      data: {suite.download}")


def prepare(given: argparse.Namespace) -> None:
    """``prepare``: rendered sequences in the cache before an evaluation needs them."""
    from eval.suites import prepare as ahead

    folders = ahead.prepare([suite for name in given.suites for suite in read_suites(name)])
    if given.sheet and folders:
        ahead.write_sheet(given.sheet, folders)


def vocabulary(given: argparse.Namespace) -> None:
    """``vocabulary``: a vocabulary for ORB-SLAM3."""
    from eval.systems.peers.vocabulary import train_on_renderings

    options = {name: value for name, value in vars(given).items() if name not in ("verb", "out")}
    print_line(train_on_renderings(given.out, **options))


def progress(text: str) -> None:
    """Print progress to the error stream, so that the table can be piped."""
    print_line(text, error=True)


def names_in(text: str) -> list[str]:
    """``a, b`` as a list, each once."""
    return list(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))


def _finish(out: Path, page: bool) -> None:
    manifest = read_manifest(out)
    rows = score_all(out, manifest)
    print_line(write_tables(out, manifest, rows).removesuffix("\n"), lines=True)
    files = [RESULTS, TABLE, AXES, *([LOOPS] if (out / LOOPS).is_file() else [])]
    if page:
        write_report(out, manifest, rows)
        files.append(PAGE)
    progress(f"results in {out}: {', '.join(files)}")


def _state(suite, sequence, data: Path | None) -> str:  # type: ignore[no-untyped-def]
    if is_rendered(sequence):
        return "rendered when needed"
    if data is None:
        return "no data folder"
    there = data / settle(suite, sequence, data).path
    return "there" if there.exists() else f"missing: {data / sequence.path}"


def _need_evo() -> None:
    if find_spec("evo") is None:
        raise DvoError("evo is not installed", remedy="pip install -e '.[eval]'")


VERBS: dict[str, Callable[[argparse.Namespace], None]] = {
    "run": run,
    "score": score,
    "report": report,
    "list": show_list,
    "prepare": prepare,
    "vocabulary": vocabulary,
}
