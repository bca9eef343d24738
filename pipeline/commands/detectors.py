"""``dynoscope detectors``: what a store holds, and which detector is champion."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.commands.ingest import add_map_arguments, names_of

if TYPE_CHECKING:
    from pipeline.store import Store

HELP = "the detector store: list, show, compare, promote, rollback, export, import"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    said = {
        "list": "all detectors, each loaded and checked",
        "show": "what a detector was made of and learned from, and when it was champion",
        "compare": "a champion and a challenger: on held-out logs, or as they were compared before",
        "promote": "make a detector the champion of its recipe",
        "rollback": "make the champion before this one champion again",
        "export": "copy detectors into a folder, which is a store too",
        "import": "take detectors in, each checked",
    }
    made = {name: actions.add_parser(name, help=text, description=text) for name, text in said.items()}
    made["show"].add_argument("keys", nargs="+", metavar="KEY", help="a key or its beginning, or champion")
    two = "two keys, or one that is compared with the champion"
    made["show"].add_argument(
        "--plot", type=Path, metavar="FILE", help="draw the study of map sizes (.png, .svg), if there was one"
    )
    made["compare"].add_argument("keys", nargs="+", metavar="KEY", help=two)
    made["compare"].add_argument("--on", nargs="+", metavar="LOG", help="fault-free logs neither has seen")
    made["compare"].add_argument("--details", action="store_true", help="also the rows of single regimes")
    made["compare"].add_argument("--report", type=Path, metavar="FILE.html", help="a page of it, with plots")
    made["compare"].add_argument(
        "--timeline", type=Path, metavar="FILE.rrd",
        help="residuals of both on the same axes, for each LOG of --on, to be opened with `view`",
    )  # fmt: skip
    add_map_arguments(made["compare"])
    made["promote"].add_argument("--force", action="store_true", help="even if it was found worse")
    made["promote"].add_argument("keys", nargs=1, metavar="KEY", help="a key or its beginning")
    made["export"].add_argument("keys", nargs="*", metavar="KEY", help="default: all")
    paths = made["import"].add_argument("paths", nargs="+", type=Path, metavar="PATH")
    paths.help = "KEY.json, with KEY.npz beside it, or a folder of them"
    made["export"].add_argument("--to", required=True, type=Path, metavar="DIR", help="where they go")
    for name in ("promote", "rollback"):
        made[name].add_argument("--reason", default="", metavar="TEXT", help="why; goes into the history")
    for name in ("show", "rollback"):
        made[name].add_argument("--recipe", metavar="NAME", help="needed if the store has several")
    for action in made.values():
        action.add_argument("--store", required=True, type=Path, metavar="DIR", help="where they are kept")
        action.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    from ingest.errors import StoreError
    from pipeline.retraining import promote
    from pipeline.store import Store

    if args.action != "import" and not args.store.exists():
        raise StoreError(f"store {args.store}: there is no such folder")
    store = Store(args.store)
    if args.action == "list":
        return _list(store, as_json=args.json)
    if args.action == "show":
        keys = [_key(store, k, args.recipe) for k in args.keys]
        if args.plot:
            _plot(store, keys[0], args.plot)
        return _show(store, keys, as_json=args.json)
    if args.action == "compare":
        return _compare(store, args)
    if args.action == "promote":
        detector = store.load(store.resolve(args.keys[0]))
        promote(store, detector, args.reason, force=args.force)
        keys = [detector.key]
    elif args.action == "rollback":
        keys = [store.rollback(_recipe(store, args.recipe), args.reason or "rolled back")]
    elif args.action == "export":
        wanted = [store.resolve(k) for k in args.keys] or [e["key"] for e in store.survey()]
        keys = _copy([(store, key) for key in wanted], Store(args.to), champions=False)
    else:
        found = [pair for path in args.paths for pair in _meant(path)]
        keys = _copy(found, store, champions=True)
    return _say(keys, as_json=args.json)


def _say(keys: list[str], *, as_json: bool) -> int:
    from pipeline.console import print_json

    if as_json:
        print_json(keys)
    else:
        print("\n".join(keys))
    return 0


def _list(store: Store, *, as_json: bool) -> int:
    from pipeline.console import print_json, print_table

    entries = store.survey()
    if as_json:
        print_json(entries)
    else:
        rows = [{**e, "champion": "champion" if e["champion"] else None} for e in entries]
        for row in rows:
            row |= {kind: len(row.get(kind, ())) for kind in ("training", "calibration")}
        headings = ("key", "recipe", "champion", "created", "training", "calibration", "problem")
        print_table(rows, {h: h for h in headings})
    return 1 if any(e["problem"] for e in entries) else 0


def _show(store: Store, keys: list[str], *, as_json: bool) -> int:
    from pipeline.commands.explain import lines
    from pipeline.console import print_json
    from pipeline.lineage import explain

    shown: list[dict[str, Any]] = []
    for key in keys:
        detector = store.load(key)
        history = store.history(detector.recipe.name)
        was = [e for e in history if e["key"] == key]
        shown.append({**detector.record, "champion": history[-1:] == was[-1:] != [], "history": was})
        if not as_json:
            print("\n".join(lines(explain(store.folder / f"{key}.json"))))
            for entry in was:
                print(f"  champion from {entry['since']}: {entry['reason']}")
            print(f"  stages {', '.join(f'{s} {v}' for s, v in detector.record['versions'].items())}")
    if as_json:
        print_json(shown)
    return 0


def _plot(store: Store, key: str, path: Path) -> None:
    """Draws the study of map sizes.

    Raises:
        StoreError: the detector has none, or the file's suffix is not that of a picture.
    """
    from ingest.errors import StoreError
    from pipeline.files import aside
    from stages.relations import Relations
    from viz.topology import save_topology

    relations = [s for s in store.load(key).stages if isinstance(s, Relations)]
    studies = {
        n: s.learned[f"{n}/study"] for s in relations for n in s.relations if f"{n}/study" in s.learned
    }
    if not studies:
        raise StoreError(
            f"detector {key} was fitted without a study of map sizes; "
            "give the recipe's relations sizes = [4, 8, 12, 16]"
        )
    if path.suffix not in (".png", ".svg"):
        raise StoreError(f"--plot {path}: expected a .png or .svg file")
    with aside(path) as draft:
        save_topology(studies, draft)


def _compare(store: Store, args: argparse.Namespace) -> int:
    from ingest.errors import StoreError
    from ingest.files import find_logs
    from pipeline.commands.retrain import print_comparison, read_all
    from pipeline.console import Problems, print_json, progress
    from pipeline.retraining import compared
    from pipeline.viewing import write_compared

    if len(args.keys) > 2:
        raise StoreError(f"detectors compare takes one key or two, got {len(args.keys)}")
    challenger = store.load(store.resolve(args.keys[-1]))
    other = args.keys[0] if len(args.keys) == 2 else "champion"
    champion = store.load(_key(store, other, challenger.recipe.name))
    if args.timeline and not args.on:
        raise StoreError(f"--timeline {args.timeline}: there is nothing to draw; name logs with --on")
    if args.on:
        logs = read_all({"on": find_logs(args.on)}, names_of(args), Problems())["on"]
        if args.timeline:
            write_compared(champion, challenger, logs, args.timeline)
        with progress("comparing", len(logs)) as step:
            found = compared(store, champion, challenger, logs, step)
    elif (kept := store.comparison(champion.key, challenger.key)) is not None:
        found = kept
    else:
        raise StoreError(
            f"detectors {champion.key} and {challenger.key} have not been compared; "
            "give fault-free logs that neither has seen with --on"
        )
    if args.report:
        _page(found, args.report)
    if args.json:
        print_json(found)
    else:
        print_comparison(found, details=args.details)
    return 0


def _page(found: dict[str, Any], path: Path) -> None:
    """Writes the comparison as a page.

    Raises:
        StoreError: that cannot be done.
    """
    from ingest.errors import StoreError
    from pipeline.files import write_aside
    from pipeline.retraining import because
    from viz.comparison import comparison_page

    try:
        write_aside(path, comparison_page(found, because(found)).encode())
    except OSError as error:
        raise StoreError(f"--report {path}: cannot be written: {error.strerror or error}") from None


def _key(store: Store, key: str, recipe: str | None) -> str:
    return store.champion(_recipe(store, recipe)) if key == "champion" else store.resolve(key)


def _recipe(store: Store, recipe: str | None) -> str:
    """The recipe meant: the only one, if none is named."""
    from ingest.errors import StoreError

    known = sorted({str(r["recipe"]) for r in store.records()})
    if recipe is None and len(known) == 1:
        return known[0]
    if recipe is None:
        listed = ", ".join(known) or "none"
        raise StoreError(f"store {store.folder} has detectors of {listed}; name one with --recipe")
    return recipe


def _meant(path: Path) -> list[tuple[Store, str]]:
    """The detectors that a path means, each with the folder it lies in."""
    from ingest.errors import StoreError
    from pipeline.store import Store

    if path.is_dir():
        found = [(Store(path), e["key"]) for e in Store(path).survey()]
        if not found:
            raise StoreError(f"{path}: no detectors in this folder")
        return found
    if path.suffix not in (".json", ".npz") or not path.is_file():
        raise StoreError(f"{path} is not a detector; expected KEY.json, with KEY.npz beside it, or a folder")
    return [(Store(path.parent), path.stem)]


def _copy(found: list[tuple[Store, str]], to: Store, *, champions: bool) -> list[str]:
    """Copies detectors once all of them have been checked; their keys. ``champions``: the first of a recipe
    becomes one."""
    detectors = [source.load(key) for source, key in found]
    for detector in detectors:
        if champions:
            to.add(detector)
        else:
            to.keep(detector)
    return [detector.key for detector in detectors]
