"""Runs a benchmark by its name: `python -m benchmarks NAME [options]`; without a name, says which there are."""

import ast
import importlib
import sys
from pathlib import Path

HERE = Path(__file__).parent


def names() -> dict[str, str]:
    """The modules that have a `main`, with the first line of what they say of themselves."""
    trees = {path.stem: ast.parse(path.read_text()) for path in sorted(HERE.glob("[!_]*.py"))}
    return {
        name: (ast.get_docstring(tree) or "").partition("\n")[0]
        for name, tree in trees.items()
        if any(isinstance(node, ast.FunctionDef) and node.name == "main" for node in tree.body)
    }


def main() -> None:
    """Give the rest of the command line to the benchmark."""
    known = names()
    if len(sys.argv) > 1 and sys.argv[1] in known:
        sys.argv = [f"python -m benchmarks {sys.argv[1]}", *sys.argv[2:]]
        importlib.import_module(f"benchmarks.{sys.argv[0].split()[-1]}").main()
        return
    print("\n".join([str(__doc__).strip(), "", *(f"{name:18}{says}" for name, says in known.items())]))
    sys.exit(len(sys.argv) > 1 and sys.argv[1] not in ("-h", "--help"))


if __name__ == "__main__":
    main()
