"""Running a detector over many logs: one bad log never stops the rest, and what is done is not done again."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from os.path import commonpath
from pathlib import Path
from tempfile import TemporaryDirectory

import polars as pl

from ingest.errors import DynoscopeError, LogError
from ingest.files import unique_stems, url_of
from ingest.maps import NameMap, load_map
from pipeline.cache import Cache
from pipeline.detector import Detector
from pipeline.digest import map_digest
from pipeline.engines import Engine, Processes, Serial
from pipeline.files import sweep
from pipeline.recipe import Recipe
from pipeline.remote_out import fetch_folder, inside
from pipeline.summary import SUMMARY, VEHICLES, Row, Summary
from pipeline.task import Task, done, failure, pack, run_task

Progress = Callable[[str, Row], None]


@dataclass(frozen=True, kw_only=True)
class Options:
    """How a batch is run; none of these changes what a verdict says.

    ``workers`` processes of this machine, or the workers of a dask cluster whose ``scheduler`` has this
    address.
    """

    timeline: bool = True
    force: bool = False
    only_failed: bool = False
    name_map: NameMap | Path | None = None
    workers: int = 1
    scheduler: str | None = None
    cache: Path | None = None
    debug: bool = False


def run(
    logs: Sequence[Path],
    detector: Detector,
    out: Path,
    options: Options | None = None,
    progress: Progress = lambda log, row: None,
) -> pl.DataFrame:
    """Diagnose ``logs`` into ``out/<log>/`` and return the summary, one row per log, failed ones too.

    ``summary.parquet`` and ``summary.csv`` in ``out`` are right at every moment; logs of earlier batches
    stay in them.

    Raises:
        LogError: ``out`` cannot be written.
        StoreError: the cache cannot be written.
    """
    options = options or Options()
    if options.cache:
        Cache(options.cache).check()
    with _folder(out) as (here, url):
        tasks = plan(logs, detector, out, options)
        summary = Summary(here, [task.name for task in tasks], url)
        todo = [t for t in tasks if not options.only_failed or has_failed(summary, t)]
        with _engine(options, detector.recipe) as engine:
            for task, row in _outcomes(engine, todo):
                row |= {"recipe": detector.recipe.name, "detector": detector.key}
                summary.add(row)
                progress(task.name, row)
        summary.finish()
        return summary.frame(only=[task.name for task in tasks])


@contextmanager
def _folder(out: Path) -> Iterator[tuple[Path, str | None]]:
    """The output folder on this machine, and the URL where it really is, if it is behind one."""
    if url := url_of(out):
        with TemporaryDirectory(prefix="dynoscope-") as name:
            fetch_folder(url, Path(name), (f"{SUMMARY}.parquet", VEHICLES))
            yield Path(name), url
        return
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LogError(f"output folder {out} cannot be made: {error.strerror or error}") from None
    sweep(out)
    try:
        yield out, None
    finally:
        sweep(out)  # drafts of workers that are no more


def plan(logs: Sequence[Path], detector: Detector, out: Path, options: Options) -> list[Task]:
    """The tasks of a batch, one per log, in order."""
    packed, names = pack(detector), options.name_map
    names = load_map(names) if isinstance(names, Path) else names
    return [
        Task(
            path=path, name=name, folder=_inside(out, name), detector=packed, name_map=names,
            map_digest=map_digest(names), vehicle=vehicle,
            timeline=options.timeline, force=options.force, cache=options.cache, debug=options.debug,
        )
        for path, name, vehicle in zip(logs, unique_stems(logs), vehicles_by_folder(logs), strict=True)
    ]  # fmt: skip


def _inside(out: Path, name: str) -> Path:
    url = url_of(out)
    return out / name if url is None else Path(inside(url, name))


def vehicles_by_folder(logs: Sequence[Path]) -> list[str | None]:
    """Whose logs they are by their folders below the one that holds them all; where that is, says nothing.

    >>> vehicles_by_folder([Path("fleet/car1/a.csv"), Path("fleet/car2/b.csv")])
    ['car1', 'car2']
    >>> vehicles_by_folder([Path("fleet/car1/a.csv"), Path("fleet/car1/b.csv")])
    [None, None]
    """
    folders = [path.absolute().parent for path in logs]
    common = Path(commonpath(folders)) if folders else Path()
    return [folder.relative_to(common).parts[0] if folder != common else None for folder in folders]


def to_do(logs: Sequence[Path], detector: Detector, out: Path, options: Options) -> list[tuple[str, str]]:
    """What :func:`run` would do with each log: ``run`` (and why) or ``done``; nothing is written."""
    tasks = plan(logs, detector, out, options)
    with _folder(out) if url_of(out) else nullcontext((out, None)) as (here, _):
        summary = Summary(here, [task.name for task in tasks])
        return [(task.name, _intent(task, summary, options)) for task in tasks]


def _intent(task: Task, summary: Summary, options: Options) -> str:
    if options.only_failed and not has_failed(summary, task):
        return "leave: it has not failed"
    if options.force:
        return "run: forced"
    if done(task):
        return "done"
    if has_failed(summary, task):
        return "run: it failed before"
    return "run: changed or incomplete" if task.folder.exists() else "run: new"


def has_failed(summary: Summary, task: Task) -> bool:
    """Whether an earlier batch could not diagnose the log."""
    return task.name in summary.earlier and summary.earlier[task.name]["status"] == "failed"


def _outcomes(engine: Engine, tasks: Sequence[Task]) -> Iterator[tuple[Task, Row]]:
    """The tasks and their rows, as they are done."""
    waiting, running = deque(tasks), dict[Future[Row], Task]()
    while waiting or running:
        while waiting and len(running) < engine.window:
            task = waiting.popleft()
            running[engine.submit(run_task, task)] = task
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            task = running.pop(future)
            try:
                yield task, future.result()
            except ConnectionError as error:
                raise DynoscopeError(str(error)) from None
            except Exception as error:  # the worker died, or could not even begin
                yield task, failure(task, error)


@contextmanager
def _engine(options: Options, recipe: Recipe) -> Iterator[Engine]:
    """The engine that the options ask for; after Ctrl-C or an error it drops what it was doing."""
    engine: Engine
    if options.scheduler:
        from pipeline.cluster import Cluster

        engine = Cluster(options.scheduler, {u.partition(":")[0] for u in recipe.uses if ":" in u})
    else:
        engine = Processes(options.workers) if options.workers > 1 else Serial()
    try:
        yield engine
    except BaseException:
        engine.abandon()
        raise
    engine.shutdown()
