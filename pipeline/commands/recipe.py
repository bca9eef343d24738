"""``dynoscope recipe``: list, show and check recipes."""

from __future__ import annotations

import argparse

HELP = "list the built-in recipes, print one to copy and edit, or check one's own"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    actions.add_parser("list", help="names and titles of the built-in recipes")
    show = actions.add_parser("show", help="print a recipe")
    show.add_argument("name", metavar="NAME", help="a built-in recipe or a path")
    check = actions.add_parser("check", help="list every mistake of a recipe")
    check.add_argument("name", metavar="FILE", help="a path or a built-in recipe")


def run(args: argparse.Namespace) -> int:
    from pipeline.recipe import builtin_recipes, load_recipe, recipe_text

    if args.action == "list":
        for name in builtin_recipes():
            print(f"{name:16s} {load_recipe(name).title}")
    elif args.action == "show":
        print(recipe_text(args.name), end="")
    else:
        recipe = load_recipe(args.name)
        print(f"recipe {recipe.name}: no mistakes; stages {', '.join(recipe.uses)}")
        print(f"needs the signals {', '.join(recipe.signals)}")
    return 0
